"""The process of a bridge: `python -m cartpole_rl.plants.drivers '{...}'`, started by `plants/emulated.py`.

One JSON line, ``{"port": "/dev/pts/3", "pid": 4711}``, goes to stdout when the board measures.
"""

import json
import os
import signal
import sys

from cartpole_rl.emulator.link import Channel, open_link
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.drivers.bridge import Bridge, driver_error
from cartpole_rl.plants.settings import BOARDS
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.scheduling import take_precedence
from cartpole_rl.signals import RaiseOnce, end_with_parent, ending_signals, starting_process


def main(text: str) -> int:
    """Bridge a board until a signal or the end of the parent process; return the exit status."""
    end_with_parent(starting_process())
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a driver prints is not the port, and may not fill a pipe that nobody reads
    sys.stdout = sys.stderr
    given = json.loads(text)
    settings = BOARDS.validate_python(given["plant"])
    hardware = Hardware.model_validate(given["hardware"])
    driver = settings.driver(settings, hardware.encoders)
    bridge = Bridge(settings, hardware, driver, given["control_period"], given["lever_um"])
    RaiseOnce(lambda number: KeyboardInterrupt()).handle(signal.SIGINT, *ending_signals())
    try:
        with bridge, open_link("auto") as link, bridge:  # ended twice: a signal may break the first end off
            bridge.listen()
            print(json.dumps({"port": link.port, "pid": os.getpid()}), file=answer, flush=True)
            take_precedence()
            bridge.run(Channel(link, EmulatorSettings(clock="real")))
    except KeyboardInterrupt:
        return 0
    except Exception as error:
        error = driver_error(settings, error)
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
