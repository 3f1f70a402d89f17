"""The emulated cart's own record: commands carried out, motor values in force, end stops touched.

One JSON line for each event, with `us` in microseconds since the emulator's start:
{"us": 40210, "took": "SET_MOTOR", "motor": -200, "tick": 2}; {"us": 43310, "in_force": -200};
{"us": 61310, "touched": 0.08}, in m/s.
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

    def touched(self, us: int, speed: float) -> None:
        """Record that the cart has touched an end stop at `speed` m/s."""
        self._write(us, touched=round(speed, 4))

    def in_force(self, us: int, motor: int) -> None:
        """Record the motor value in force if it has changed."""
        if motor != self._motor:
            self._motor = motor
            self._write(us, in_force=motor)

    def _write(self, us: int, **event: Any) -> None:
        self._file.write(json.dumps({"us": us, **event}) + "\n")
