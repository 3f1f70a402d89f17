"""A line for each finished run: how many are done, and how long the others still take."""

from collections import defaultdict
from collections.abc import Callable, Iterable

from cartpole_rl.workflows.reproduce.plan import Task

MINUTE, HOUR = 60.0, 3600.0  # s


class Progress:
    """Counts finished runs and learns how long runs take."""

    def __init__(self, total: int, jobs: int, show: Callable[[str], None]) -> None:
        self.total, self.jobs, self.show = total, jobs, show
        self.done = 0
        self._seconds: defaultdict[tuple[str, ...], list[float]] = defaultdict(list)

    def finished(self, task: Task, label: str, seconds: float, left: Iterable[Task], failure: str) -> None:
        """Show a line about a run that took `seconds`; `left` are the runs that are not done."""
        self.done += 1
        if not failure:
            for kind in kinds(task):
                self._seconds[kind].append(seconds)
        rest = self.remaining(left)
        outcome = f"FAILED: {failure}" if failure else duration(seconds)
        self.show(
            f"[{self.done:{len(str(self.total))}}/{self.total}] {task.command:8} {label}: {outcome}{rest}"
        )

    def remaining(self, left: Iterable[Task]) -> str:
        """Return how long runs still take, by the mean of those like them; empty if nothing is known.

        It is a lower limit while no run of some command has ended.
        """
        expected = [*map(self._expected, left)]
        known = [seconds for seconds in expected if seconds is not None]
        if expected and not known:
            return ""
        words = "about" if len(known) == len(expected) else "at least"
        return f", {words} {duration(sum(known) / self.jobs)} left"

    def _expected(self, task: Task) -> float | None:
        found = next((self._seconds[kind] for kind in kinds(task) if kind in self._seconds), None)
        return sum(found) / len(found) if found else None


def kinds(task: Task) -> tuple[tuple[str, ...], ...]:
    """Return what runs like this one share, the most similar first."""
    return (
        (task.study, task.command, *task.folder.parts[-1:]),
        (task.study, task.command),
        (task.command,),
    )


def duration(seconds: float) -> str:
    """Return a duration in words."""
    if seconds < MINUTE:
        return f"{seconds:.0f} s"
    if seconds < HOUR:
        return f"{seconds / MINUTE:.0f} min"
    return f"{int(seconds // HOUR)} h {int(seconds % HOUR // MINUTE)} min"
