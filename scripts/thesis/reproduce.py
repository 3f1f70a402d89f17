"""Carry out the studies of the thesis and those beyond it; the same command continues after an interruption.

    scripts/reproduce --size quick                  everything, small: 20 to 30 minutes on two cores
    scripts/reproduce friction_models perturbations --size full --jobs 8
    scripts/reproduce --list                        names all studies

Each run has its folder, <folder>/<size>/<study>/<arm>/<seed>. Complete runs are skipped, an interrupted
training is resumed, an interrupted evaluation repeated. A run that fails does not end the others.
`scripts/thesis/report.py <folder>/<size>` shows the results.
"""

import argparse
import multiprocessing
import os
import shlex
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from plan import Task, needed, plan
from study import STUDIES, load_study, study_names
from worker import MODULES, SIGNALLED, in_own_process, is_complete, made_otherwise, reason_of

from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.files import FULL, claimed, write_text
from cartpole_rl.run_folder import LOG
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.terminal import exit_if_nobody_reads

CHECKOUT = Path(__file__).resolve().parents[2]
RUNS = Path("runs/reproduce")  # in the checkout
MINUTE, HOUR = 60.0, 3600.0  # s
GRACE = 10.0  # s from SIGTERM to SIGKILL: an emulated cart is stopped, a cart's motor set to 0

Outcome = tuple[Task, float, str]  # of a run: its seconds and why it failed, empty for success


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
                study = load_study(name, source).model_copy(update={"size": size})
                text = yaml.safe_dump(study.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
                write_text(root / name / "study.yaml", text)
        show(f"{len(tasks)} runs, {schedule.counts()}; {jobs} at a time, in {root}")
        started = time.monotonic()
        progress = Progress(len(schedule.waiting), jobs, show)
        with Workers(jobs) as workers:
            while schedule.waiting or workers.running:
                ended = schedule.lost()
                for task in schedule.ready(jobs - len(workers.running)):
                    workers.start(task)
                if not ended:
                    ended = workers.finished() if workers.running else schedule.stuck()
                for task, seconds, failure in ended:
                    schedule.finish(task, failure)
                    left = [*schedule.waiting, *workers.running]
                    progress.finished(task, schedule.label(task), seconds, left, failure)
        show(f"{progress.done} runs in {duration(time.monotonic() - started)}")
    return schedule.failures


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
        for task in self._taken([task for task in self.waiting if task.study in self.mixed]):
            self.finish(task, "other runs of its study were made with other settings")

    def label(self, task: Task) -> str:
        """Return the folder of a run below that of all studies."""
        return str(task.folder.relative_to(self._root))

    def counts(self) -> str:
        """Return how many runs are done and, if there are any, how many are refused."""
        refused = f", {len(self.failures)} refused" if self.failures else ""
        return f"{len(self._complete)} of them done{refused}"

    def lost(self) -> list[Outcome]:
        """Take the runs that need a failed one."""
        needing = [task for task in self.waiting if self._failed.intersection(task.needs)]
        return [
            (task, 0.0, f"it needs {min(map(str, self._failed.intersection(task.needs)))}, which failed")
            for task in self._taken(needing)
        ]

    def stuck(self) -> list[Outcome]:
        """Take the runs that need each other; none of them can ever start."""
        circle = self.waiting
        while len(inner := [task for task in circle if task.folder in needed(circle)]) < len(circle):
            circle = inner
        return [
            (task, 0.0, f"it needs {min(map(str, task.needs))}; they need each other")
            for task in self._taken(circle)
        ]

    def ready(self, count: int) -> list[Task]:
        """Take up to `count` runs whose needs are complete."""
        return self._taken([task for task in self.waiting if self._complete.issuperset(task.needs)][:count])

    def _taken(self, tasks: list[Task]) -> list[Task]:
        self.waiting = [task for task in self.waiting if task not in tasks]
        return tasks

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
    """The processes of runs; at the end of a `with` all are stopped.

    They are forked from one that has imported everything, where the system can: importing takes as long as a
    short evaluation.
    """

    jobs: int
    running: dict[Task, Running] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._context: Any = multiprocessing.get_context("spawn")
        if "forkserver" in multiprocessing.get_all_start_methods():
            self._context = multiprocessing.get_context("forkserver")
            self._context.set_forkserver_preload(MODULES)

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


class Progress:
    """A line for each finished run: how many are done, and how long the others still take."""

    def __init__(self, total: int, jobs: int, show: Callable[[str], None]) -> None:
        self.total, self.jobs, self.show = total, jobs, show
        self.done = 0
        self._seconds: defaultdict[tuple[str, ...], list[float]] = defaultdict(list)

    def finished(self, task: Task, label: str, seconds: float, left: Iterable[Task], failure: str) -> None:
        """Show a line about a run that took `seconds`; `left` are the runs that are not done."""
        self.done += 1
        if not failure:
            for kind in _kinds(task):
                self._seconds[kind].append(seconds)
        outcome = f"FAILED: {failure}" if failure else duration(seconds)
        number = f"{self.done:{len(str(self.total))}}/{self.total}"
        self.show(f"[{number}] {task.command:8} {label}: {outcome}{self._remaining(left)}")

    def _remaining(self, left: Iterable[Task]) -> str:
        """Return how long runs still take, by the mean of those like them; empty if nothing is known.

        It is a lower limit while no run of some command has ended.
        """
        like = [
            next((self._seconds[kind] for kind in _kinds(task) if kind in self._seconds), []) for task in left
        ]
        known = [sum(seconds) / len(seconds) for seconds in like if seconds]
        if like and not known:
            return ""
        words = "about" if len(known) == len(like) else "at least"
        return f", {words} {duration(sum(known) / self.jobs)} left"


def _kinds(task: Task) -> tuple[tuple[str, ...], ...]:
    """Return what runs like this one share, the most similar first."""
    return (task.study, task.command, task.folder.name), (task.study, task.command), (task.command,)


def duration(seconds: float) -> str:
    """Return a duration in words."""
    if seconds < MINUTE:
        return f"{seconds:.0f} s"
    if seconds < HOUR:
        return f"{seconds / MINUTE:.0f} min"
    return f"{int(seconds // HOUR)} h {int(seconds % HOUR // MINUTE)} min"


def parse_options() -> argparse.Namespace:
    """Return the command-line options."""
    parser = argparse.ArgumentParser(
        "scripts/reproduce", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help="studies (all)")
    parser.add_argument("--size", default="quick", help="quick (default) or full")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time (one per core)")
    parser.add_argument("--folder", type=as_in_checkout, default=RUNS, help="of the results (runs/reproduce)")
    parser.add_argument(
        "--studies", type=as_in_checkout, default=STUDIES, help="of studies (scripts/thesis/studies)"
    )
    parser.add_argument("--list", action="store_true", help="name all studies and end")
    return parser.parse_args()


def as_in_checkout(path: str) -> Path:
    """Return a path of the caller's, as it is named in the checkout: everything runs there."""
    whole = Path.cwd() / path
    return whole.relative_to(CHECKOUT) if whole.is_relative_to(CHECKOUT) and whole != Path(path) else whole


def list_studies(source: Path) -> None:
    """Print a table: the name, the figure or section of the thesis and the question of each study."""
    studies = {name: load_study(name, source) for name in study_names(source)}
    rows = [(name, study.place, study.question) for name, study in studies.items()]
    rows = [("study", "figure or section", "question"), *rows]
    wide, middle = (max(len(row[column]) for row in rows) for column in (0, 1))
    for name, figure, question in rows:
        print(f"{name:{wide}}  {figure:{middle}}  {question}")


def run(options: argparse.Namespace, caller: Path) -> int:
    """Reproduce the chosen studies for a caller in a folder; return the exit code. Raises ConfigError."""
    root, source = options.folder / options.size, options.studies
    names = options.names or study_names(source)
    if options.jobs < 1:
        raise ConfigError(f"--jobs {options.jobs}: give at least 1")
    sizes = dict.fromkeys(size for name in names for size in load_study(name, source).sizes)
    if options.size not in sizes:
        raise ConfigError(f"--size {options.size}: give {' or '.join(sizes)}")
    failures = reproduce(names, options.size, root, options.jobs, source, partial(print, flush=True))
    for label, reason in failures.items():
        print(f"scripts/reproduce: {label} failed: {reason}", file=sys.stderr)
    page = root if caller == CHECKOUT else CHECKOUT / root
    print(f"the page: scripts/thesis/report.py {shlex.quote(str(page))}")
    return 1 if failures else 0


def main() -> int:
    """List the studies or reproduce them; return the exit code."""
    options, caller = parse_options(), Path.cwd()
    os.chdir(CHECKOUT)
    RaiseOnce(lambda number: KeyboardInterrupt(number)).handle(signal.SIGINT, *ending_signals())
    try:
        if options.list:
            list_studies(options.studies)
            return 0
        return run(options, caller)
    except ConfigError as error:
        print(f"scripts/reproduce: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        exit_if_nobody_reads()
        raise
    except OSError as error:
        remedy = "; make room, then give the same command again" if error.errno in FULL else ""
        print(f"scripts/reproduce: {reason_of(error)}{remedy}", file=sys.stderr)
        return CartPoleError.exit_code
    except KeyboardInterrupt as signalled:
        print("scripts/reproduce: interrupted; the same command continues", file=sys.stderr)
        return SIGNALLED + (signalled.args or (signal.SIGINT,))[0]


if __name__ == "__main__":
    sys.exit(main())
