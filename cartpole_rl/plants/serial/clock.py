"""The host's clock for everything that waits for a cart: it goes on while the computer sleeps.

`time.perf_counter` stands still then on Linux and macOS: a state from before the sleep would look
new, and the motor value that answers it would be sent.
"""

import statistics
import time

# Linux's has this name; macOS counts the time asleep in its CLOCK_MONOTONIC, and Windows in perf_counter
_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))


def now() -> float:
    """Return s since an arbitrary moment, with the time asleep."""
    return time.perf_counter() if _CLOCK is None else time.clock_gettime(_CLOCK)


class ClockComparison:
    """Compares the clock of a cart with this computer's, by the arrivals of its states.

    An arrival can be late but never early: of each second by the cart's clock the earliest counts. The median
    of several comparisons is not disturbed by a second in which this computer was busy. After a pause, such
    as a question to a person, what waited in a buffer comes at once: a comparison begins anew after that.
    """

    SECONDS = 8  # that are compared, the newest
    LONGEST_PAUSE = 0.5  # s between two arrivals; the longest period is 0.1 s
    CATCHING_UP = 1.0  # s after a pause and at first; what waited has been read by then

    def __init__(self) -> None:
        self._earliest: list[float] = []  # s that the host's clock was ahead, of each second so far
        self._elapsed = 0.0  # s by the cart's clock since the first state
        self._second = -1  # that is under way
        self._arrived_at: float | None = None  # of the last state
        self._late_until = 0.0

    def add(self, elapsed: float, arrived_at: float) -> float | None:
        """Add a state, `elapsed` s after the last one by the cart's clock, that arrived at a time in s.

        Returns the rate of the cart's clock (1.3: it passes 1.3 s in a second) when a second has ended and
        enough have been compared, otherwise None.
        """
        last, self._arrived_at = self._arrived_at, arrived_at
        if last is None or arrived_at - last > self.LONGEST_PAUSE:
            self._late_until = arrived_at + self.CATCHING_UP
        if arrived_at < self._late_until:
            self._forget()
            return None
        self._elapsed += elapsed
        ahead, second = arrived_at - self._elapsed, int(self._elapsed)
        if second == self._second:
            self._earliest[-1] = min(self._earliest[-1], ahead)
            return None
        rate = self._rate()
        self._earliest = [*self._earliest[-self.SECONDS :], ahead] if second == self._second + 1 else [ahead]
        self._second = second
        return rate

    def _forget(self) -> None:
        self._earliest, self._elapsed, self._second = [], 0.0, -1

    def _rate(self) -> float | None:
        complete, half = self._earliest[1:], self.SECONDS // 2  # the first second was cut short
        if len(complete) < self.SECONDS:
            return None
        drifts = [(after - before) / half for before, after in zip(complete, complete[half:], strict=False)]
        return 1 / max(1e-3, 1 + statistics.median(drifts))
