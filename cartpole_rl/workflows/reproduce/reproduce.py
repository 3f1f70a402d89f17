"""Reproduce studies: all their runs, several at a time, each in a process of its own.

The processes are forked from one that has imported everything, where the system can: importing takes as long
as a short evaluation. A run that fails does not end the others. Complete runs are skipped, so the same call
continues after an interruption.
"""

import multiprocessing
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from cartpole_rl.files import claimed, write_text
from cartpole_rl.run_files import LOG
from cartpole_rl.workflows.reproduce.plan import Task, needed, plan
from cartpole_rl.workflows.reproduce.process import in_own_process, is_complete, made_otherwise
from cartpole_rl.workflows.reproduce.progress import Progress, duration
from cartpole_rl.workflows.studies import STUDIES, load_study

STUDY_FILE = "study.yaml"
WORKER = "cartpole_rl.workflows.reproduce.carry_out"  # imports all workflows
Outcome = tuple[Task, float, str]  # of a run: its seconds and why it failed, empty for success
GRACE = 10.0  # s from SIGTERM to SIGKILL: an emulated cart is stopped, a cart's motor set to 0


def reproduce(
    names: Sequence[str],
    size: str,
    root: Path,
    jobs: int,
    source: Path = STUDIES,
    show: Callable[[str], None] = print,
) -> dict[str, str]:
    """Run everything that is left of the studies `names` of `source`, in `root`; return the failures by run.

    Raises ConfigError for an unknown study or size, or if another process works in `root`.
    """
    tasks = plan(names, size, root, source)
    with claimed(root):
        schedule = Schedule(tasks, root)
        for name in names:
            if name not in schedule.mixed:  # else the study that its runs were made by stays
                write_study(name, size, root, source)
        show(f"{len(tasks)} runs, {schedule.counts()}; {jobs} at a time, in {root}")
        started = time.monotonic()
        progress = Progress(len(schedule.waiting), jobs, show)
        with Workers(jobs) as workers:
            while schedule.waiting or workers.running:
                ended = schedule.lost()
                for task in schedule.ready(workers.free):
                    workers.start(task)
                if not ended:
                    ended = workers.finished() if workers.running else schedule.stuck()
                for task, seconds, failure in ended:
                    schedule.finish(task, failure)
                    left = [*schedule.waiting, *workers.tasks]
                    progress.finished(task, schedule.label(task), seconds, left, failure)
        show(f"{progress.done} runs in {duration(time.monotonic() - started)}")
    return schedule.failures


def write_study(name: str, size: str, root: Path, source: Path = STUDIES) -> None:
    """Write the study with its size beside its runs."""
    study = load_study(name, source)
    content = study.model_copy(update={"size": size}).model_dump(mode="json")
    write_text(root / name / STUDY_FILE, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


class Schedule:
    """The runs that are not done, in order, and the failures so far.

    A run is done if those that it needs are done, too. A study with runs of other settings is `mixed`, and
    gets no more runs.
    """

    def __init__(self, tasks: Sequence[Task], root: Path) -> None:
        self._root = root
        self.failures: dict[str, str] = {}
        self._complete: set[Path] = set()
        self._failed: set[Path] = set()
        self.waiting: list[Task] = []
        self.mixed: set[str] = set()
        done = completed(tasks)
        for task in tasks:
            if task.folder not in done:
                self.waiting.append(task)
            elif other := made_otherwise(task):
                self.mixed.add(task.study)
                self.finish(task, other)
            else:
                self._complete.add(task.folder)
        blocked = [task for task in self.waiting if task.study in self.mixed]
        for task in blocked:
            self.finish(task, "other runs of its study were made with other settings")
        self._take(blocked)

    def label(self, task: Task) -> str:
        """Return the folder of a run below that of all studies."""
        return str(task.folder.relative_to(self._root))

    def counts(self) -> str:
        """Return how many runs are done and, if there are any, how many are refused."""
        refused = f", {len(self.failures)} refused" if self.failures else ""
        return f"{len(self._complete)} of them done{refused}"

    def lost(self) -> list[Outcome]:
        """Take the runs that need a failed one."""
        taken = [
            (task, 0.0, f"it needs {min(map(str, failed))}, which failed")
            for task in self.waiting
            if (failed := self._failed.intersection(task.needs))
        ]
        self._take([task for task, _, _ in taken])
        return taken

    def stuck(self) -> list[Outcome]:
        """Take the runs that need each other; none of them can ever start."""
        circle = self.waiting
        while len(inner := [task for task in circle if task.folder in needed(circle)]) < len(circle):
            circle = inner
        self._take(circle)
        return [(task, 0.0, f"it needs {min(map(str, task.needs))}; they need each other") for task in circle]

    def ready(self, count: int) -> list[Task]:
        """Take up to `count` runs whose needs are complete."""
        chosen = [task for task in self.waiting if self._complete.issuperset(task.needs)][:count]
        self._take(chosen)
        return chosen

    def _take(self, tasks: Sequence[Task]) -> None:
        self.waiting = [task for task in self.waiting if task not in tasks]

    def finish(self, task: Task, failure: str) -> None:
        """Note the outcome of a run."""
        if failure:
            self.failures[self.label(task)] = failure
            self._failed.add(task.folder)
        else:
            self._complete.add(task.folder)


def completed(tasks: Sequence[Task]) -> set[Path]:
    """Return the folders of the runs that are complete, as well as those that they need."""
    found = {task.folder: task for task in tasks if is_complete(task)}
    while lacking := [folder for folder, task in found.items() if not found.keys() >= {*task.needs}]:
        for folder in lacking:
            del found[folder]
    return {*found}


class Running(NamedTuple):
    """A run under way: its process, when it started, and where its process says why it failed."""

    process: BaseProcess
    since: float
    reasons: Connection

    def reason(self) -> str:
        """Return what the ended process said; empty if it said nothing."""
        with self.reasons, suppress(EOFError, OSError):
            return str(self.reasons.recv()) if self.reasons.poll() else ""
        return ""


@dataclass
class Workers:
    """The processes of runs, at most `jobs` at a time; at the end of a `with` all are stopped."""

    jobs: int
    running: dict[Task, Running] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._context: Any = multiprocessing.get_context("spawn")
        if "forkserver" in multiprocessing.get_all_start_methods():
            self._context = multiprocessing.get_context("forkserver")
            self._context.set_forkserver_preload([WORKER])

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: object) -> None:
        processes = [run.process for run in self.running.values()]
        for process in processes:
            process.terminate()
        deadline = time.monotonic() + GRACE
        for process in processes:
            process.join(max(0.0, deadline - time.monotonic()))
            process.kill()

    @property
    def free(self) -> int:
        """How many more runs may start."""
        return self.jobs - len(self.running)

    @property
    def tasks(self) -> list[Task]:
        """The runs under way."""
        return [*self.running]

    def start(self, task: Task) -> None:
        """Start a run."""
        reasons, sender = self._context.Pipe(duplex=False)
        with sender:  # the process has a copy
            process = self._context.Process(target=in_own_process, args=(task, sender))
            process.start()
        self.running[task] = Running(process, time.monotonic(), reasons)

    def finished(self) -> list[Outcome]:
        """Wait for the next end of a run; return those that ended."""
        wait([run.process.sentinel for run in self.running.values()])
        ended = [task for task, run in self.running.items() if run.process.exitcode is not None]
        outcomes = []
        for task in ended:
            run = self.running.pop(task)
            failure = failure_of(task, run.process.exitcode or 0, run.reason())
            outcomes.append((task, time.monotonic() - run.since, failure))
        return outcomes


def failure_of(task: Task, exit_code: int, reason: str) -> str:
    """Return why a run failed: the `reason` that its process gave, if it did; empty if it did not fail."""
    if exit_code < 0:
        return f"signal {-exit_code} ended its process"
    if exit_code == 0:
        return "" if is_complete(task) else f"it ended without all of its results; see its {LOG}"
    return reason or f"exit status {exit_code}"
