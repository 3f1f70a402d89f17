"""A potentiometer at the pole, which measures less than a whole turn: the rest is its dead zone."""

CARRIED_US = 200_000  # longest time in the dead zone; a swing through 25 degrees needs a quarter of it
SPEED_US = 20_000  # shortest time by which the speed is known


class Potentiometer:
    """Carries the pole through the dead zone, at the speed with which it came, and never out of it.

    `low` and `high` are the readings between which it is right, and `turn` the counts of a whole turn.
    """

    def __init__(self, low: int, high: int, turn: int) -> None:
        self._low, self._high, self._turn = low, high, turn
        self._right: list[tuple[int, int]] = []  # the newest right readings and their times in us
        self._speed = 0.0  # counts/us
        self.width = 0  # counts of the dead zone, if the newest accepted reading was in it

    def count(self, reading: int, us: int) -> int | None:
        """Return the pole's count at a reading; None after too long in the dead zone, or with none before."""
        if self._low <= reading <= self._high:
            return reading
        if not self._right:
            return None
        last, passed = self._right[-1][0], us - self._right[-1][1]
        if not 0 <= passed <= CARRIED_US:
            return None
        upward = self._high - last < last - self._low
        nearest, farthest = (
            (self._high, self._low + self._turn) if upward else (self._high - self._turn, self._low)
        )
        return round(max(nearest, min(farthest, last + self._speed * passed)))

    def accept(self, reading: int, us: int) -> None:
        """Note a reading that is plausible."""
        if not self._low <= reading <= self._high:
            self.width = self._turn - (self._high - self._low)
            return
        if self.width:
            self._right, self.width = [], 0
        self._right.append((reading, us))
        while len(self._right) > 2 and us - self._right[1][1] >= SPEED_US:
            del self._right[0]
        first, since = self._right[0]
        if us > since:
            self._speed = ((reading - first + self._turn // 2) % self._turn - self._turn // 2) / (us - since)

    def forget(self) -> None:
        """Forget the readings before, which were of another zero."""
        self._right, self._speed, self.width = [], 0.0, 0
