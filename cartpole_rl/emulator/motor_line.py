"""Delayed motor values: each comes into force one latency after its arrival.

Times are whole microseconds since boot.
"""

from collections import deque

MOST_PENDING = 1024  # the line's memory is bounded, as a board's is


class MotorLine:
    """The motor value in force and the pending ones. No command overtakes another."""

    def __init__(self) -> None:
        self.blocked = 0  # direction that the soft limit forbids: 1 right, -1 left, 0 none
        self._requested = 0
        self._pending: deque[tuple[int, int]] = deque()  # (due, value)

    @property
    def value(self) -> int:
        """Motor value in force."""
        return 0 if self.limited else self._requested

    @property
    def limited(self) -> bool:
        """True if the command in force points in the forbidden direction and is held at 0."""
        return self._requested * self.blocked > 0

    def command(self, due_us: int, value: int) -> None:
        """Bring a value into force at `due_us`, or together with an earlier command that is due later.

        If no more commands can wait, the value replaces the newest one.
        """
        newest = self._pending[-1][0] if self._pending else 0
        if len(self._pending) == MOST_PENDING:
            self._pending.pop()
        self._pending.append((max(due_us, newest), value))

    def stop(self, now_us: int) -> None:
        """Bring 0 into force at `now_us` and discard values that are due later."""
        while self._pending and self._pending[-1][0] > now_us:
            self._pending.pop()
        self.command(now_us, 0)

    def hold(self, value: int) -> None:
        """Put a value into force at once and discard all pending ones."""
        self._pending.clear()
        self._requested = value

    def over(self, start_us: int, end_us: int) -> list[tuple[int, int]]:
        """Return the values in force from start to end as (since, value); the last one remains in force."""
        values = [(start_us, self.value)]
        while self._pending and self._pending[0][0] < end_us:
            due, self._requested = self._pending.popleft()
            values.append((max(due, start_us), self.value))
        return values
