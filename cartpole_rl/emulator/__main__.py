"""``python -m cartpole_rl.emulator '{"clock": "real"}'``: an emulated cart for the program that starts it.

The argument has the settings as JSON. One JSON line, ``{"port": "/dev/pts/3", "pid": 4711}``, goes to stdout
when the port can be opened. The cart ends with the process that started it. Exit status: 0 after SIGINT or
SIGTERM, 2 for invalid settings, 1 if the cart cannot be emulated on this machine.
"""

import os
import sys

from pydantic import ValidationError

from cartpole_rl.emulator.device import run
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.signals import end_with_parent, starting_process


def main(text: str = "{}") -> int:
    """Run an emulated cart until it is interrupted; return the exit status."""
    end_with_parent(starting_process())
    os.environ["MUJOCO_GL"] = "disable"  # nothing is drawn: MuJoCo need not import a window library
    try:
        run(read_settings(text))
    except CartPoleError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except OSError as error:
        of_file = f"journal={error.filename}: {error.strerror}; give the path of a new file"
        print(of_file if error.filename else error, file=sys.stderr)
        return 1
    return 0


def read_settings(text: str) -> EmulatorSettings:
    """Return the settings in a JSON text. Raises ConfigError with one line that names every wrong key."""
    try:
        return EmulatorSettings.model_validate_json(text)
    except ValidationError as error:
        wrong = [f"{'.'.join(map(str, item['loc'])) or 'settings'}: {item['msg']}" for item in error.errors()]
        raise ConfigError("emulator settings: " + "; ".join(wrong)) from None


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:2]))
