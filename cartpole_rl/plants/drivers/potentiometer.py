"""A potentiometer at the pole, which measures less than a whole turn: the rest is its dead zone."""

CARRIED_US = 200_000  # longest time in the dead zone; a swing through 25 degrees needs a quarter of it


class Potentiometer:
    """Carries the pole through the dead zone, at the speed with which it came.

    `low` and `high` are the readings between which it is right, and `turn` the counts of a whole turn.
    """

    def __init__(self, low: int, high: int, turn: int) -> None:
        self._low, self._high, self._turn = low, high, turn
        self._last: tuple[int, int] | None = None  # the newest right reading, and its time in us
        self._speed = 0.0  # counts/us, by the last two

    def is_right(self, reading: int) -> bool:
        """Return whether a reading lies outside the dead zone."""
        return self._low <= reading <= self._high

    def count(self, reading: int, us: int) -> int | None:
        """Return the pole's count at a reading; None after too long in the dead zone, or with none before."""
        if self.is_right(reading):
            return reading
        if self._last is None:
            return None
        last, passed = self._last[0], us - self._last[1]
        if not 0 <= passed <= CARRIED_US:
            return None
        downward, upward = self._high - self._turn - last, self._low + self._turn - last  # to its other end
        return round(last + max(downward, min(upward, self._speed * passed)))

    def accept(self, reading: int, us: int) -> None:
        """Note a reading that is plausible."""
        if not self.is_right(reading):
            return
        if self._last is not None and us > self._last[1]:
            moved = (reading - self._last[0] + self._turn // 2) % self._turn - self._turn // 2
            self._speed = moved / (us - self._last[1])
        self._last = reading, us

    def forget(self) -> None:
        """Forget the readings before, which were of another zero."""
        self._last, self._speed = None, 0.0
