"""The plan of a reproduction: which run of which command goes to which folder, and what it needs first.

In the overrides of a study `{runs}` stands for the folder of all studies and `{seed}` for the seed of the
agent, as in `run={runs}/todays_agents/medium/{seed}`. An arm of a training with `run=` trains no agent: that
agent, or the baseline of run=lqr, is evaluated, with the other overrides of the arm.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.settings import Size, Study, Variant, setting
from cartpole_rl.workflows.studies import STUDIES, load_study, overrides_of, unknown

EVALUATIONS = "evaluations"  # folder in that of an agent
BASELINE = "lqr"
RESUMABLE = ("train", "finetune")  # commands


@dataclass(frozen=True)
class Task:
    """One run: its command, folder and overrides, and the folders of the runs that it needs."""

    study: str
    command: str
    folder: Path
    root: Path  # folder of all studies, as `words` name it
    words: tuple[str, ...]
    needs: tuple[Path, ...] = ()

    @property
    def overrides(self) -> dict[str, Any]:
        """The overrides by name."""
        return overrides_of(self.words, self.root)

    def was_made_by(self, words: Sequence[str]) -> bool:
        """Return True for the words of this run, wherever the folder of all studies was then."""
        own = [re.escape(word).replace(re.escape(f"{self.root}/"), ".*/") for word in self.words]
        return len(words) == len(own) and all(map(re.fullmatch, own, words))


def plan(names: Sequence[str], size: str, root: Path, source: Path = STUDIES) -> list[Task]:
    """Return the runs of the studies `names` and the runs of others that they need, in order.

    Raises ConfigError for an unknown study or size.
    """
    tasks = {task.folder: task for name in names for task in study_tasks(name, size, root, source)}
    missing = needed(tasks.values()) - tasks.keys()
    while missing:
        others = _studies_of(missing, root)
        if absent := others.difference(file.stem for file in source.glob("*.yaml")):
            needing = next(task for task in tasks.values() if _studies_of(task.needs, root) & absent)
            name = min(_studies_of(needing.needs, root) & absent)
            raise ConfigError(f"{needing.study}: it needs runs of the study {name}, which is not in {source}")
        found = {
            task.folder: task for name in sorted(others) for task in study_tasks(name, size, root, source)
        }
        if lost := sorted(missing - found.keys()):
            raise ConfigError(f"{lost[0]}: a study needs this run, but no study of size {size} has it")
        tasks = {**{folder: found[folder] for folder in sorted(missing)}, **tasks}
        missing = needed(tasks.values()) - tasks.keys()
    return list(tasks.values())


def _studies_of(folders: Iterable[Path], root: Path) -> set[str]:
    """Return the names of the studies that the run folders belong to."""
    return {folder.relative_to(root).parts[0] for folder in folders}


def needed(tasks: Iterable[Task]) -> set[Path]:
    """Return the folders of the runs that `tasks` need."""
    return {folder for task in tasks for folder in task.needs}


def study_tasks(name: str, size: str, root: Path, source: Path = STUDIES) -> list[Task]:
    """Return all runs of a study, each agent before its evaluations. Raises ConfigError."""
    study = load_study(name, source)
    chosen = size_of(name, study, size)
    return [
        task
        for arm in study.arms
        for seed in chosen.every_seed
        for task in Agent(name, study, chosen, arm, seed, root).tasks()
    ]


def size_of(name: str, study: Study, size: str) -> Size:
    """Return a size of a study. Raises ConfigError if it has no such size."""
    if size not in study.sizes:
        raise ConfigError(f"study {name}: {unknown('size', size, [*study.sizes])}")
    return study.sizes[size]


@dataclass(frozen=True)
class Agent:
    """One agent of a study, or one run of another command: an arm and a seed."""

    name: str
    study: Study
    size: Size
    arm: Variant
    seed: int
    root: Path

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.root / self.name / self.arm.name / str(self.seed)

    def tasks(self) -> Iterator[Task]:
        """Yield the run itself, unless it evaluates an agent of another study, then its evaluations."""
        agent = f"{{runs}}/{self.name}/{self.arm.name}/{{seed}}"
        if self.study.command != "train" or self.shared is None:
            yield self.own_task()
        else:
            agent = self.shared
        if agent == BASELINE:
            words = self.words(f"run={BASELINE}", *self.size.evaluation_overrides)
            yield Task(self.name, "evaluate", self.folder, self.root, words)
        for evaluation in self.study.evaluations:
            own = evaluation.words(self.arm.name, self.size.evaluation_overrides)
            words = self.words(f"run={agent}", *self.study.evaluated_with(self.arm), *own)
            needs = tuple(self.runs_in(words))
            folder = self.folder / EVALUATIONS / evaluation.name
            yield Task(self.name, "evaluate", folder, self.root, words, needs)

    def own_task(self) -> Task:
        """Return the run of the study's command."""
        study = self.study
        experiment = [f"experiment={study.experiment}"] if study.experiment else []
        words = self.words(*experiment, *self.arm.overrides, *self.size.overrides)
        needs = tuple(self.runs_in(words, own=False))
        return Task(self.name, study.command, self.folder, self.root, words, needs)

    @property
    def shared(self) -> str | None:
        """The run that this arm evaluates, with its placeholders; None if it trains an agent of its own."""
        return self.study.shared_agent(self.arm)

    def words(self, *overrides: str) -> tuple[str, ...]:
        """Return overrides with their placeholders filled in, and the seed; of one setting the last."""
        every = [*map(self.filled, overrides), f"seed={self.seed}"]
        last = {setting(word): word for word in every}
        return tuple(last.values())

    def filled(self, text: str) -> str:
        """Return `text` with `{runs}` and `{seed}` filled in."""
        return text.replace("{seed}", str(self.seed)).replace("{runs}", str(self.root))

    def runs_in(self, words: Iterable[str], own: bool = True) -> Iterator[Path]:
        """Yield the run folders of studies that `words` name, the `own` one too."""
        for word in words:
            for found in re.findall(rf"{re.escape(str(self.root))}/([^/,\]]+/[^/,\]]+/\d+)", word):
                if own or self.root / found != self.folder:
                    yield self.root / found
