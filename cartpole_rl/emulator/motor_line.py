"""Delayed motor values: each comes into force one latency after its arrival.

Times are whole microseconds since boot.
"""

from collections import deque

MOST_PENDING = 1024  # the line's memory is bounded, as a board's is


class MotorLine:
    """The requested motor value and the pending ones. No command overtakes another."""

    def __init__(self) -> None:
        self.requested = 0
        self._pending: deque[tuple[int, int]] = deque()  # (due, value)

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
        self.requested = value

    def drive(self, now_us: int) -> None:
        """Bring the values that are due into force."""
        while self._pending and self._pending[0][0] <= now_us:
            _, self.requested = self._pending.popleft()

    def next_due(self, before_us: int) -> int:
        """Return when the next value is due, `before_us` if none is due before that."""
        return min(before_us, self._pending[0][0]) if self._pending else before_us
