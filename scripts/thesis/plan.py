"""The plan of a reproduction: which run of which command goes to which folder, and what it needs first."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from study import RUN, STUDIES, Size, Study, Variant, load_study, overrides_of, setting, unknown

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.results import EVALUATIONS

BASELINE = "lqr"


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
    while missing := needed(tasks.values()) - tasks.keys():
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
    if size not in study.sizes:
        raise ConfigError(f"study {name}: {unknown('size', size, study.sizes)}")
    chosen = study.sizes[size]
    return [
        task
        for arm in study.arms
        for seed in chosen.every_seed
        for task in _tasks(name, study, chosen, arm, seed, root)
    ]


def _tasks(name: str, study: Study, size: Size, arm: Variant, seed: int, root: Path) -> Iterator[Task]:
    """Yield the run of an arm and a seed, unless it evaluates another agent, then its evaluations."""
    place = root / name / arm.name / str(seed)

    def task(command: str, folder: Path, *overrides: str) -> Task:
        filled = (each.replace("{seed}", str(seed)).replace("{runs}", str(root)) for each in overrides)
        last = {setting(word): word for word in (*filled, f"seed={seed}")}  # of one setting the last
        words = tuple(last.values())
        needs = (run for run in _runs_in(words, root) if run != folder)
        return Task(name, command, folder, root, words, tuple(needs))

    agent = study.shared_agent(arm) if study.command == "train" else None
    if agent is None:
        experiment = [f"experiment={study.experiment}"] if study.experiment else []
        yield task(study.command, place, *experiment, *arm.overrides, *size.overrides)
    elif agent == BASELINE:
        yield task("evaluate", place, f"{RUN}{BASELINE}", *size.evaluation_overrides)
    agent = agent or f"{{runs}}/{name}/{arm.name}/{{seed}}"
    for evaluation in study.evaluations:
        words = (*study.evaluated_with(arm), *evaluation.words(arm.name, size.evaluation_overrides))
        yield task("evaluate", place / EVALUATIONS / evaluation.name, f"{RUN}{agent}", *words)


def _runs_in(words: Iterable[str], root: Path) -> Iterator[Path]:
    """Yield the run folders of studies that `words` name."""
    for word in words:
        for found in re.findall(rf"{re.escape(str(root))}/([^/,\]]+/[^/,\]]+/\d+)", word):
            yield root / found
