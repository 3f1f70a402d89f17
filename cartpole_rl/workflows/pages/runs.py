"""Reads run folders for a report: settings, results, versions, and why a run does not count."""

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import yaml

from cartpole_rl.run_files import COMPARISON, CONFIG, HISTORY, IDENTIFIED, METRICS, MODELLED, PROVENANCE
from cartpole_rl.workflows.run_folder import PREFIX
from cartpole_rl.workflows.run_inputs import is_outdated

RESULTS = {"identify": (IDENTIFIED,), "model": (MODELLED,), "finetune": (METRICS, COMPARISON)}
EPISODIC = ("evaluate", "record")  # commands that keep what they have after an interruption
# packages whose versions change results
COMPARED_PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "numpy", "mujoco")
# settings that seeds of one set-up may differ in; the last parts of dotted names
FREE = ("seed", "label", "threads", "run", "resume", "from", "port", "journal")
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times faster, where it was compiled

Item = TypeVar("Item")


@dataclass(frozen=True)
class Run:
    """A run folder. `problem` says why it does not count; it is empty for a complete run."""

    folder: Path
    program: str = ""  # the command, without its prefix
    config: Mapping[str, Any] = field(default_factory=dict)
    results: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    problem: str = ""

    @cached_property
    def settings(self) -> dict[str, Hashable]:
        """The settings by dotted name that the seeds of one set-up share."""
        return shared_settings(self.config)

    @property
    def seed(self) -> int | None:
        """The seed of the run."""
        seed = self.config.get("seed")
        return seed if isinstance(seed, int) else None

    @property
    def versions(self) -> str:
        """The versions of the packages that change results: "cartpole_rl 0.1.0, torch 2.15.0, ..."."""
        packages = self.provenance.get("packages") or {}
        return ", ".join(f"{name} {packages[name]}" for name in COMPARED_PACKAGES if packages.get(name))

    @property
    def commit(self) -> str:
        """The commit that made the run, shortened; "-dirty" stays."""
        whole, _, dirty = (self.provenance.get("git_commit") or "").partition("-")
        return whole[:10] + (f"-{dirty}" if dirty else "")


def read_run(folder: Path) -> Run:
    """Return the run in `folder`, with a problem if it is unfinished or damaged."""
    try:
        config = yaml.load((folder / CONFIG).read_text(encoding="utf-8"), LOADER)
        provenance = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
        program = str(provenance["program"]).removeprefix(PREFIX)
    except FileNotFoundError as error:
        return Run(folder, problem=f"it has no {Path(error.filename).name}")
    except (OSError, ValueError, yaml.YAMLError, LookupError, TypeError) as error:
        return Run(folder, problem=f"damaged: {_short(error)}")
    if not isinstance(config, dict):
        return Run(folder, problem=f"damaged: {CONFIG} holds no settings")
    run = Run(folder, program, config, provenance=provenance)
    try:
        results = _results(folder, program)
    except FileNotFoundError as error:
        return replace(run, problem=f"unfinished: it has no {Path(error.filename).name}")
    except (OSError, ValueError) as error:
        return replace(run, problem=f"damaged results: {_short(error)}")
    outdated = "a run that it needs was made again since, with another result" if is_outdated(folder) else ""
    return replace(run, results=results, problem=_interruption(program, config, results) or outdated)


def _results(folder: Path, program: str) -> dict[str, Any]:
    """Return the content of the files of results; those after the first by the names of the files."""
    first, *others = (
        (Path(name).stem, json.loads((folder / name).read_text(encoding="utf-8")))
        for name in RESULTS.get(program, (METRICS,))
    )
    if not isinstance(first[1], dict):
        raise ValueError(f"{first[0]}.json holds no results")
    return {**first[1], **dict(others)}


def _interruption(program: str, config: Mapping[str, Any], results: Mapping[str, Any]) -> str:
    """Return the problem of an evaluation with fewer episodes than it was started with."""
    if program not in EPISODIC:
        return ""
    done, asked = len(results.get("episodes") or ()), config.get("episodes")
    return f"interrupted: {done} of {asked} episodes" if done != asked else ""


def measured(results: Mapping[str, Any], measure: str) -> float | None:
    """Return the number at the dotted key `measure`, the mean if it is one; None if there is no number."""
    found: Any = results
    for key in measure.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    if isinstance(found, Mapping):
        found = found.get("mean")
    return float(found) if isinstance(found, int | float) and math.isfinite(found) else None


def history(folder: Path) -> list[dict[str, float]]:
    """Return the evaluations of a training; none if its file is missing or damaged."""
    try:
        lines = (folder / HISTORY).read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]
    except (OSError, ValueError):
        return []


def learning_curve(folder: Path, measure: str) -> tuple[str, list[tuple[float, float]]]:
    """Return the evaluations of a training: `measure`, or score if it has none, and (transitions, value)."""
    records = history(folder)
    name = measure if all(measure in each for each in records) else "score"
    return name, [(each["transitions"], each[name]) for each in records]


def shared_settings(tree: Mapping[str, Any]) -> dict[str, Hashable]:
    """Return the settings by dotted name without those that are FREE."""
    return {name: value for name, value in flattened(tree).items() if name.rpartition(".")[2] not in FREE}


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Hashable]:
    """Return nested settings by dotted name; lists as text."""
    flat: dict[str, Hashable] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat |= flattened(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value if isinstance(value, Hashable) else json.dumps(value)
    return flat


def find_runs(folder: Path) -> Iterator[Path]:
    """Yield `folder` if it is a run, else the runs anywhere below it, in order; runs inside runs are not."""
    for here, folders, files in os.walk(folder):
        folders.sort()
        if CONFIG in files:
            folders.clear()
            yield Path(here)


def split_by_majority(
    items: Sequence[Item], key: Callable[[Item], Hashable]
) -> tuple[list[Item], list[tuple[Item, Hashable]]]:
    """Return the items with the most frequent key (the first of several), and the others with that key."""
    if not items:
        return [], []
    common, _ = Counter(map(key, items)).most_common(1)[0]
    same = [item for item in items if key(item) == common]
    return same, [(item, common) for item in items if key(item) != common]


def settings_key(run: Run) -> Hashable:
    """Return a key that runs with the same command and settings share."""
    return run.program, tuple(sorted(run.settings.items(), key=lambda item: item[0]))


def settings_difference(run: Run, common: Run, most: int = 3) -> str:
    """Return in words where the settings of `run` differ from those of `common`."""
    names = sorted(
        name
        for name in {*run.settings, *common.settings}
        if run.settings.get(name) != common.settings.get(name)
    )
    shown = [
        f"{name} {_plain(run.settings.get(name))} instead of {_plain(common.settings.get(name))}"
        for name in names[:most]
    ]
    more = [f"{len(names) - most} more"] if len(names) > most else []
    if run.program != common.program:
        shown.insert(0, f"a run of {PREFIX}{run.program} instead of {PREFIX}{common.program}")
    return ", ".join((*shown, *more))


def commits_note(runs: Iterable[Run]) -> str:
    """Return a sentence about runs of several commits; empty for one."""
    counts = Counter(run.commit or "no commit" for run in runs)
    if len(counts) < 2:
        return ""
    each = ", ".join(f"{commit} ({count})" for commit, count in counts.most_common())
    return f"The runs are of {len(counts)} commits with the same package versions: {each}."


def _plain(value: Hashable) -> str:
    return "unset" if value is None else str(value)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]
