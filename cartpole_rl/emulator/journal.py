"""The emulated cart's own record of the commands that it carried out and of the motor values in force.

One JSON line for each event, with `us` in microseconds since the emulator's start:
{"us": 40210, "took": "SET_MOTOR", "motor": -200} and {"us": 43310, "in_force": -200}.
"""

import json
from pathlib import Path
from typing import Any

from cartpole_rl.wire import Message


class Journal:
    """Writes events to a new file at once. Raises FileExistsError: it overwrites no file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("x", buffering=1, encoding="utf-8")
        self._motor = 0

    def took(self, us: int, message: Message) -> None:
        """Record a command that the cart carried out."""
        self._write(us, took=message.TYPE.name, **vars(message))

    def in_force(self, us: int, motor: int) -> None:
        """Record the motor value in force if it has changed."""
        if motor != self._motor:
            self._motor = motor
            self._write(us, in_force=motor)

    def _write(self, us: int, **event: Any) -> None:
        self._file.write(json.dumps({"us": us, **event}) + "\n")
