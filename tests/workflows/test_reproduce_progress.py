"""The time left is that of runs like those left; where no run of a command has ended, it is a lower limit."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from cartpole_rl.workflows.reproduce.plan import Task
from cartpole_rl.workflows.reproduce.progress import Progress

ROOT = Path("runs")


def run(command: str, study: str = "toy", arm: str = "arm") -> Task:
    return Task(study, command, ROOT / study / arm / "10", ROOT, ())


TRAIN, EVALUATE, OTHER = run("train"), run("evaluate"), run("train", study="other")


def last_line(done: Sequence[tuple[Task, float, str]], left: Sequence[Task]) -> str:
    """The line after the last of `done`: runs, their seconds and why they failed."""
    lines: list[str] = []
    progress = Progress(9, 2, lines.append)
    for task, seconds, failure in done:
        progress.finished(task, "run", seconds, left, failure)
    return lines[-1].partition("run: ")[2]


@pytest.mark.parametrize(
    ("done", "left", "line"),
    [
        ([(TRAIN, 90, "")], [TRAIN, TRAIN], "2 min, about 2 min left"),
        ([(TRAIN, 90, "")], [OTHER], "2 min, about 45 s left"),
        ([(TRAIN, 90, ""), (OTHER, 10, "")], [TRAIN], "10 s, about 45 s left"),
        ([(EVALUATE, 5, "")], [TRAIN], "5 s"),
        ([(EVALUATE, 6, "")], [TRAIN, EVALUATE], "6 s, at least 3 s left"),
        ([(EVALUATE, 6, ""), (TRAIN, 90, "")], [TRAIN, EVALUATE], "2 min, about 48 s left"),
        ([(TRAIN, 1, "it diverged")], [TRAIN], "FAILED: it diverged"),
        ([(EVALUATE, 6, ""), (TRAIN, 1, "it diverged")], [EVALUATE], "FAILED: it diverged, about 3 s left"),
        ([(TRAIN, 90, "")], [], "2 min, about 0 s left"),
    ],
)
def test_the_time_left_is_that_of_similar_runs(
    done: Sequence[tuple[Task, float, str]], left: Sequence[Task], line: str
) -> None:
    assert last_line(done, left) == line
