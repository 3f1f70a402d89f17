"""The process of a bridge: `python -m cartpole_rl.plants.drivers '{...}'`, started by `plants/emulated.py`.

One JSON line, ``{"port": "/dev/pts/3", "pid": 4711}``, goes to stdout when the board measures.
"""

import json
import os
import sys

from cartpole_rl.emulator.link import Channel, open_link
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CartPoleError
from cartpole_rl.plants.drivers.bridge import Bridge
from cartpole_rl.plants.settings import BOARDS
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.scheduling import take_precedence
from cartpole_rl.signals import end_with_parent, starting_process, until_stopped


def main(text: str) -> int:
    """Bridge a board until a signal or the end of the parent process; return the exit status."""
    end_with_parent(starting_process())
    given = json.loads(text)
    settings = BOARDS.validate_python(given["plant"])
    hardware = Hardware.model_validate(given["hardware"])
    driver = settings.driver(settings, hardware.encoders)
    bridge = Bridge(settings, hardware, driver, given["control_period"], given["lever_um"])
    try:
        with until_stopped(), open_link("auto") as link:
            try:
                bridge.listen()
            except BaseException:
                driver.close()
                raise
            print(json.dumps({"port": link.port, "pid": os.getpid()}), flush=True)
            take_precedence()
            bridge.run(Channel(link, EmulatorSettings(clock="real")))
    except CartPoleError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
