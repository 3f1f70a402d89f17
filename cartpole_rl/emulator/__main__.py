"""``python -m cartpole_rl.emulator '{"clock": "real"}'``: start an emulated cart and print its port.

One JSON line, ``{"port": "/dev/pts/3", "pid": 4711}``, goes to stdout when the port can be opened. Exit
status: 0 after SIGINT or SIGTERM, 2 for invalid settings, 1 if the cart cannot be emulated on this machine.
"""

import argparse
import sys

from pydantic import ValidationError

from cartpole_rl.emulator.device import run
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.signals import end_with_parent, starting_process


def main(arguments: list[str] | None = None) -> int:
    """Run an emulated cart until it is interrupted; return the exit status."""
    parent = starting_process()
    parser = argparse.ArgumentParser(
        prog="python -m cartpole_rl.emulator",
        description="Emulate a cart on a pseudo-terminal or a TCP port. Prints its port as one JSON line.",
    )
    parser.add_argument(
        "settings",
        nargs="?",
        default="{}",
        help='settings as JSON, such as \'{"clock": "real"}\' (docs/emulator.md)',
    )
    parser.add_argument("--exit-with-parent", action="store_true", help="stop when the parent process ends")
    options = parser.parse_args(arguments)
    try:
        settings = read_settings(options.settings)
        if options.exit_with_parent:
            end_with_parent(parent)
        run(settings)
    except CartPoleError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"journal={error.filename}: {error.strerror}; give the path of a new file", file=sys.stderr)
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
    sys.exit(main())
