"""Motor values on their way to the motor: each comes into force a latency after it arrived.

Times are whole microseconds since boot.
"""

from collections import deque


class MotorLine:
    """The value in force, and the ones that are still due. Order is kept: no command overtakes another."""

    def __init__(self) -> None:
        self.blocked = 0  # the direction that a soft limit forbids: 1 right, -1 left, 0 none
        self._requested = 0
        self._pending: deque[tuple[int, int]] = deque()  # (due, value)

    @property
    def value(self) -> int:
        """Motor value in force."""
        return 0 if self.limited else self._requested

    @property
    def limited(self) -> bool:
        """Whether the newest command in force points where it may not, and is held at 0."""
        return self._requested * self.blocked > 0

    def command(self, due_us: int, value: int) -> None:
        """Bring a value into force at a time, or when the one before it is in force if that is later."""
        newest = self._pending[-1][0] if self._pending else 0
        self._pending.append((max(due_us, newest), value))

    def stop(self, now_us: int) -> None:
        """Bring 0 into force now, and forget what is due later."""
        while self._pending and self._pending[-1][0] > now_us:
            self._pending.pop()
        self.command(now_us, 0)

    def hold(self, value: int) -> None:
        """Put a value into force at once, and forget all that is due."""
        self._pending.clear()
        self._requested = value

    def over(self, start_us: int, end_us: int) -> list[tuple[int, int]]:
        """What is in force from start to end, as (since, value); afterwards the last one is in force."""
        values = [(start_us, self.value)]
        while self._pending and self._pending[0][0] < end_us:
            due, self._requested = self._pending.popleft()
            values.append((max(due, start_us), self.value))
        return values
