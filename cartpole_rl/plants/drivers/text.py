"""Lines of text, as makers' firmware often sends them: `t_us,x,theta` one way, a number the other.

    12340000,-812,1003      a line of the board: its clock, the cart, the pole
    a=-3.200                a line of this computer: the motor

Columns, units, separator and the lines that are sent are settings (`TextSettings`). A line that is not whole,
or has anything but finite numbers in its columns, is dropped and counted.
"""

import math
import re
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from cartpole_rl.errors import LinkError
from cartpole_rl.plants.drivers.driver import CLOCK_WRAP, Driver, Measurement, unwrapped
from cartpole_rl.plants.serial.port import open_port, resolved_port, set_exclusive
from cartpole_rl.rig.hardware import Encoders

if TYPE_CHECKING:
    import serial

    from cartpole_rl.plants.settings import TextSettings

LONGEST_LINE = 200  # bytes
FEW_LINES, QUEUED = 3, 0.1  # lines and s: so many that wait for so long are too old when they arrive
WHOLE = re.compile(r"[+-]?[0-9]+")
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?", re.IGNORECASE)
LARGEST_COUNT = 2**31
FINE, FEW_WHOLE = 2, 5  # counts in a unit whose numbers need decimals; so many without any are in counts
MICROSECONDS = {"us": 1, "ms": 1_000, "s": 1_000_000}


class TextDriver(Driver):
    """A board that sends a line each period and takes lines. `settings` are `TextSettings`."""

    settings: "TextSettings"

    def __init__(self, settings: "TextSettings", encoders: Encoders) -> None:
        super().__init__(settings, encoders)
        self._columns = {name: place for place, name in enumerate(settings.columns)}
        metres, radians = encoders.resolution
        self._cart_counts = {"counts": 1.0, "mm": 1e-3 / metres, "m": 1 / metres}[settings.cart_unit]
        self._pole_counts = {"counts": 1.0, "deg": math.radians(1) / radians, "rad": 1 / radians}[
            settings.pole_unit
        ]
        # the numbers of a column that has had no decimals, though its unit has many counts
        per_unit = {"cart": self._cart_counts, "pole": self._pole_counts}
        self._whole: dict[str, set[str]] = {name: set() for name, counts in per_unit.items() if counts > FINE}
        self._line: serial.SerialBase | None = None
        self._pending = b""
        self._dropping = False  # until the next line: this one is too long
        self._queued_since: float | None = None  # when lines began to wait in the system's buffer
        self._cut = True  # the board may hold a part of a line
        self._ticks: int | None = None  # the newest time in the board's unit, unwrapped
        self.port = settings.port

    def open(self) -> None:
        """Open the port. Raises PortError."""
        self.port = resolved_port(self.settings.port)
        self._line = open_port(self.port, self.settings.baud, self.settings.write_timeout)
        self._pending, self._dropping, self._cut = b"", False, True

    def read(self, timeout: float) -> Measurement | None:
        """Return the next whole line as a measurement; None if none came within `timeout` s."""
        deadline = time.monotonic() + timeout
        while True:
            while b"\n" in self._pending:
                line, _, self._pending = self._pending.partition(b"\n")
                dropped, self._dropping = self._dropping, False
                if not dropped and (measurement := self._measured(line)) is not None:
                    return measurement
            if time.monotonic() >= deadline:
                return None
            self._pending += self._received(deadline)
            if len(self._pending) > LONGEST_LINE and b"\n" not in self._pending:
                if not self._dropping:
                    self._refuse(self._pending, found=rf", {LONGEST_LINE} bytes without \n,")
                self._pending, self._dropping = b"", True

    def send(self, value: float) -> None:
        """Send the line of a motor command."""
        self._write(self.settings.line.format(value))

    def home(self) -> None:
        """Send the line that starts the board's own homing."""
        assert self.settings.home_line is not None  # the settings were checked
        self._write(self.settings.home_line)

    def stop(self) -> None:
        """Send the line that stops the motor, which is the command 0 if there is no other."""
        if self.settings.stop_line is None:
            self.send(0.0)
        else:
            self._write(self.settings.stop_line)

    def close(self) -> None:
        """Give the port back; never raises."""
        if self._line is not None:
            with suppress(OSError):
                set_exclusive(self._line, False)
                self._line.close()
            self._line = None

    def _received(self, deadline: float) -> bytes:
        """Return what has arrived, or what arrives until `deadline`. Raises LinkError."""
        line = self._opened
        try:
            line.timeout = max(0.0, deadline - time.monotonic())
            return line.read(line.in_waiting or 1)
        except OSError as error:
            raise LinkError(
                f"{self.port} cannot be read any more: {error}; is the cart unplugged?"
            ) from error

    def _write(self, text: str) -> None:
        line, data = self._opened, text.encode() + b"\n"
        try:
            self._check_queue(line, FEW_LINES * len(data))
            cut, self._cut = self._cut, True
            line.write(b"\n" + data if cut else data)
            self._cut = False
        except OSError as error:
            raise LinkError(
                f"{self.port} takes no bytes any more: {error}; is the cart unplugged?"
            ) from error

    def _check_queue(self, line: "serial.SerialBase", few: int) -> None:
        """Discard lines that have waited for long. Raises LinkError then: the newest would come too late."""
        if getattr(line, "out_waiting", 0) <= few:  # TCP has none
            self._queued_since = None
            return
        now = time.monotonic()
        self._queued_since = self._queued_since or now
        if now - self._queued_since > QUEUED:
            line.reset_output_buffer()
            self._queued_since, self._cut = None, True
            raise LinkError(
                f"{self.port} takes lines more slowly than they are sent: give the board and plant.baud, now "
                f"{self.settings.baud}, a higher rate, or a longer control_period"
            )

    @property
    def _opened(self) -> "serial.SerialBase":
        if self._line is None:
            raise LinkError(f"{self.port} is not open")
        return self._line

    def _measured(self, line: bytes) -> Measurement | None:
        """Return the measurement in a line; None, and count it as bad, if it has none."""
        settings = self.settings
        text = line.decode("ascii", errors="replace").strip(" \t\r")
        if "," not in settings.separator:
            text = text.replace(",", ".")  # the decimal comma
        words = text.split(settings.separator)
        if len(words) != len(settings.columns):
            self._refuse(line, found=f", which has {len(words)} values,")
            return None
        try:
            cart, pole = (self._number(words[self._columns[name]], name) for name in ("cart", "pole"))
            us = self._time(words[self._columns["time"]]) if "time" in self._columns else None
        except ValueError as error:
            self._refuse(line, f": {error}" if "decimals" in str(error) else "")
            return None
        counts = cart * self._cart_counts, pole * self._pole_counts
        if not all(map(math.isfinite, counts)) or max(map(abs, counts)) > LARGEST_COUNT:
            self._refuse(line)
            return None
        return Measurement(round(counts[0]), round(counts[1]), us)

    def _time(self, word: str) -> int:
        """Return the board's time in us, without the wrap of its counter. Raises ValueError if it has none.

        It goes back if the board's counter does.
        """
        unit = MICROSECONDS[self.settings.time_unit]
        if unit == MICROSECONDS["s"]:
            seconds = float(matching(NUMBER, word))
            if not abs(seconds) < CLOCK_WRAP:
                raise ValueError(f"{word} is not a time in s")
            return round(seconds * unit)
        if "." in word:
            raise ValueError(f"time has decimals, which plant.time_unit={self.settings.time_unit} has not")
        ticks = int(matching(WHOLE, word))
        self._ticks = ticks if self._ticks is None else unwrapped(ticks, self._ticks)
        return self._ticks * unit

    def _number(self, word: str, column: str) -> float:
        """Return the number of a column. Raises ValueError; LinkError if the unit seems wrong."""
        unit = getattr(self.settings, f"{column}_unit")
        counts = unit == "counts"
        if "." in word and counts:
            raise ValueError(f"{column} has decimals, so it is not in counts: give plant.{column}_unit")
        number = matching(WHOLE if counts else NUMBER, word)
        if not WHOLE.fullmatch(number):
            self._whole.pop(column, None)
        elif column in self._whole:
            self._whole[column].add(number)
            if len(self._whole[column]) >= FEW_WHOLE:
                raise LinkError(
                    f"{self.port}: {column} never has decimals, so it seems to be in counts: leave out "
                    f"plant.{column}_unit={unit}, or send decimals, or give cart= a count of 1 {unit}"
                )
        return float(number)

    def _refuse(self, line: bytes, why: str = "", found: str = "") -> None:
        self.bad += 1
        self.why_bad = (
            f"{line[:60]!r}{found} is not {self.settings.separator.join(self.settings.columns)}{why}"
        )


def matching(pattern: re.Pattern[str], word: str) -> str:
    """Return a word without blanks. Raises ValueError if it is not of the pattern: Python reads 1_0, too."""
    if not pattern.fullmatch(word := word.strip(" \t")):
        raise ValueError(f"{word} is no number")
    return word
