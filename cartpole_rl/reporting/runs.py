"""Reads run folders for a report: settings, results, versions, and why a run does not count."""

import json
import os
import re
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.errors import CheckpointError
from cartpole_rl.reporting.results import is_number
from cartpole_rl.reporting.texts import ENDINGS
from cartpole_rl.run_folder import (
    AGENT_HASH,
    CHECKPOINTS,
    COMPARISON,
    CONFIG,
    ERROR,
    HISTORY,
    IDENTIFIED,
    INPUTS,
    LOG,
    METRICS,
    MODELLED,
    PREFIX,
    PROVENANCE,
    file_hash,
    find_agent,
    is_outdated,
)

RUNS = "runs"  # the folder in which commands make their runs
RESULTS = {"identify": (IDENTIFIED,), "model": (MODELLED,), "finetune": (METRICS, COMPARISON)}
EPISODIC = ("evaluate", "record")  # commands that keep what they have after an interruption
NOT_SHOWN = ("replay", "report", "import", "export")  # commands without such results
# packages whose versions change results
COMPARED_PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "numpy", "mujoco")
# settings that seeds of one set-up may differ in; the last parts of dotted names
FREE = ("seed", "label", "threads", "run", "resume", "from", "port", "journal")
DAMAGE = (  # what reading a damaged file raises
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RecursionError,
    yaml.YAMLError,
)
BLOCK = re.compile("^(?=[A-Za-z_])", re.M)  # the start of a setting that is no part of another one
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times faster, where it was compiled


@dataclass(frozen=True)
class Run:
    """A run folder. `problem` says why it does not count; it is empty for a complete run."""

    folder: Path
    program: str = ""  # the command, without its prefix
    config: Mapping[str, Any] = field(default_factory=dict)
    results: Mapping[str, Any] = field(default_factory=dict)  # without its episodes
    provenance: Mapping[str, Any] = field(default_factory=dict)
    problem: str = ""
    episodes: int = 0  # in its results

    @cached_property
    def settings(self) -> dict[str, Hashable]:
        """The settings by dotted name that the seeds of one set-up share."""
        return shared_settings(self.config)

    @property
    def seed(self) -> int | None:
        """The seed of the run."""
        seed = self.config.get("seed")
        return seed if isinstance(seed, int) and not isinstance(seed, bool) else None

    @property
    def command(self) -> list[str]:
        """The words of the command line that started the run."""
        words = self.provenance.get("command")
        return [*map(str, words)] if isinstance(words, list) else []

    @property
    def agent(self) -> str:
        """The agent that the run evaluates, as it was given; empty for other commands."""
        return self.config.get("run") or ""

    @property
    def kept(self) -> str:
        """The policy that a fine-tuning kept, "before" or "after"; empty for other runs."""
        kept = _at(self.results, f"{Path(COMPARISON).stem}.kept")
        return kept if isinstance(kept, str) else ""

    @property
    def versions(self) -> str:
        """The versions of the packages that change results: "cartpole_rl 0.1.0, torch 2.15.0, ...".

        A run that was resumed with others has those of each start: "..., then ...".
        """
        starts = (each.get("packages") or {} for each in self._starts)
        named = (
            ", ".join(f"{name} {packages[name]}" for name in COMPARED_PACKAGES if packages.get(name))
            for packages in starts
        )
        return ", then ".join(dict.fromkeys(named))

    @property
    def commit(self) -> str:
        """The commits that made the run and its resumptions, shortened; "-dirty" stays."""
        names = ((each.get("git_commit") or "").partition("-") for each in self._starts)
        return " then ".join(
            dict.fromkeys(whole[:10] + (f"-{dirty}" if dirty else "") for whole, _, dirty in names)
        )

    @property
    def _starts(self) -> list[Mapping[str, Any]]:
        """The provenance of the first start and of each resumption."""
        return [self.provenance, *(self.provenance.get("resumed") or [])]


def read_run(folder: Path) -> Run:
    """Return the run in `folder`, with a problem if it failed, is unfinished or damaged."""
    try:
        run = _started(folder)
    except FileNotFoundError as error:
        missing = f"it has no {Path(error.filename).name}{_end_of_log(folder)}"
        return Run(folder, problem=_failure(folder) or missing)
    except DAMAGE as error:
        return Run(folder, problem=f"damaged: {short(error)}")
    try:
        results = _results(folder, run.program)
        run = replace(run, episodes=len(_episodes(results)), results=_without_episodes(results))
        return replace(run, problem=_interruption(run) or _outdated(run))
    except FileNotFoundError as error:
        missing = f"unfinished: it has no {Path(error.filename).name}{_end_of_log(folder)}"
        if run.program in NOT_SHOWN:
            missing = f"a run of {PREFIX}{run.program}, which a report does not show"
        return replace(run, problem=_failure(folder) or missing)
    except DAMAGE as error:
        return replace(run, problem=f"damaged results: {short(error)}")


def _started(folder: Path) -> Run:
    """Return the run in `folder` without its results. Raises one of DAMAGE."""
    config = _settings((folder / CONFIG).read_text(encoding="utf-8"))
    provenance = json.loads((folder / PROVENANCE).read_text(encoding="utf-8"))
    if not isinstance(config, dict):
        raise TypeError(f"{CONFIG} holds no settings")
    if not isinstance(config.get("run"), str | None):
        raise TypeError(f"run in {CONFIG} is no path")
    run = Run(folder, str(provenance["program"]).removeprefix(PREFIX), config, provenance=provenance)
    if "seed" in config and run.seed is None and config["seed"] is not None:
        raise TypeError(f"seed in {CONFIG} is no number")
    _ = run.versions, run.commit  # they raise here, not while runs are compared
    return run


def _settings(text: str) -> Any:
    """Return the settings in the text of a YAML file; those that many runs share are read once.

    They are the same objects in all of these runs.
    """
    try:
        blocks = [_block(block) for block in BLOCK.split(text) if block]
    except yaml.YAMLError:
        blocks = [None]
    if all(isinstance(block, dict) for block in blocks):
        return {name: value for block in blocks for name, value in block.items()}
    return _block(text)  # a file that was written by hand


@lru_cache(maxsize=8192)
def _block(text: str) -> Any:
    content = yaml.load(text, LOADER)
    if isinstance(content, dict):
        flattened(content)  # it raises here, not while runs are compared
    return content


def _failure(folder: Path) -> str:
    """Return why a job of a sweep failed, or that a link leads nowhere; empty for other runs."""
    if folder.is_symlink() and not folder.exists():
        return "a link to nothing"
    try:
        first = (folder / ERROR).read_text(encoding="utf-8", errors="replace").partition("\n")[0]
    except OSError:
        return ""
    return f"failed: {first[:200]}"


def _end_of_log(folder: Path) -> str:
    """Return the last line of the log of a run of scripts/reproduce; empty without one."""
    try:
        lines = (folder / LOG).read_text(encoding="utf-8", errors="replace").split("\n")
    except OSError:
        return ""
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"; its {LOG} ends with: {last[:200]}" if last else ""


def _outdated(run: Run) -> str:
    """Return the problem of a run whose agent, identified cart or model is another one now."""
    if is_outdated(run.folder):
        return "a run that it needs was made again since, with another result"
    used = run.provenance.get(AGENT_HASH)
    if used and not (run.folder / INPUTS).is_file():
        is_there = any(map(_hash, _places(run, [Path(run.agent)])))
        if is_there and _hash(place_of_agent(run)) != used:
            return f"its agent {run.agent} has another checkpoint now; repeat it"
    return ""


def place_of_agent(run: Run) -> Path:
    """Return where the agent of a run is: the place with its hash, or else as the run names it."""
    used, named = run.provenance.get(AGENT_HASH), Path(run.agent)
    if not used:
        return named
    places = (*_places(run, [named]), *_places(run, _after_a_copy(named)))
    return next((place for place in places if _hash(place) == used), named)


def _places(run: Run, names: Sequence[Path]) -> list[Path]:
    """Return where the agent of a run may be: from here, or from a folder above the run, if it was moved."""
    folders = (Path(), *run.folder.absolute().parents)
    return [*dict.fromkeys(folder / name for folder in folders for name in names)]


def _after_a_copy(named: Path) -> list[Path]:
    """Return the ends of an absolute path that begin with a folder of runs: a copy may be elsewhere."""
    parts = named.parts if named.is_absolute() else ()
    return [Path(*parts[place:]) for place, part in enumerate(parts) if part == RUNS]


def _hash(place: Path) -> str | None:
    """Return the hash of the agent at a place; None without one."""
    with suppress(CheckpointError, OSError):
        file = find_agent(place)
        about = file.stat()
        return _hash_of(file, about.st_mtime_ns, about.st_size)
    return None


@cache
def _hash_of(file: Path, changed_ns: int, size: int) -> str:
    return file_hash(file)


def _results(folder: Path, program: str) -> dict[str, Any]:
    """Return the content of the files of results; those after the first by the names of the files."""
    first, *others = (
        (Path(name).stem, json.loads((folder / name).read_text(encoding="utf-8")))
        for name in RESULTS.get(program, (METRICS,))
    )
    if not isinstance(first[1], dict):
        raise ValueError(f"{first[0]}.json holds no results")
    return {**first[1], **dict(others)}


def _interruption(run: Run) -> str:
    """Return the problem of an evaluation with fewer episodes than it was started with."""
    if run.program not in EPISODIC:
        return ""
    repeated = (run.config.get("repeat") or {}).get("run")
    asked = 1 if repeated else run.config.get("episodes")
    return f"interrupted: {run.episodes} of {asked} episodes" if run.episodes != asked else ""


def _episodes(results: Mapping[str, Any]) -> list[Any]:
    """Return what results hold of each episode. Raises TypeError."""
    episodes = results.get("episodes") or []
    if not isinstance(episodes, list):
        raise TypeError("its episodes are no list")
    return episodes


def _without_episodes(results: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: _without_episodes(content) if isinstance(content, dict) else content
        for name, content in results.items()
        if name != "episodes"
    }


def measured(results: Mapping[str, Any], measure: str) -> float | None:
    """Return the number at the dotted key `measure`, the mean if it is one; None if there is no number."""
    found = _at(results, measure)
    if isinstance(found, Mapping):
        found = found.get("mean")
    return float(found) if is_number(found) else None


def _at(results: Mapping[str, Any], measure: str) -> Any:
    found: Any = results
    above = ""
    for key in measure.split("."):
        absent = 0 if above == "ended_by" and key in ENDINGS else None  # its counts lack those of 0
        found, above = found.get(key, absent) if isinstance(found, Mapping) else None, key
    return found


def partly_measured_note(runs: Iterable[Run], measure: str) -> str:
    """Return a sentence about means over fewer episodes than the runs have; empty if there is none."""
    counts = [
        (found["count"], run.episodes)
        for run in runs
        if isinstance(found := _at(run.results, measure), Mapping) and is_number(found.get("count"))
    ]
    partial = [(count, all_) for count, all_ in counts if count < all_]
    if not partial:
        return ""
    having, every = map(sum, zip(*partial, strict=True))
    return (
        f"{measure}: only {having} of {every} episodes of {len(partial)} runs have it; "
        "their means are over these episodes."
    )


def learning_curve(folder: Path, measure: str) -> tuple[str, list[tuple[float, float]]]:
    """Return the evaluations of a training: `measure`, or score if it has none, and (transitions, value).

    There is none without a file. Raises ValueError for a damaged one.
    """
    if not (folder / HISTORY).exists():
        return measure, []
    records = [*_history(folder / HISTORY)]
    name = measure if all(is_number(each.get(measure)) for each in records) else "score"
    return name, [(each["transitions"], each[name]) for each in records]


def _history(file: Path) -> Iterator[dict[str, Any]]:
    """Yield the lines of a history. Raises ValueError for one without transitions and score."""
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            record = json.loads(line)
            good = is_number(record["transitions"]) and is_number(record["score"])
        except DAMAGE:
            good = False
        if not good:
            raise ValueError(f"line {number} of {file.name} is damaged")
        yield record


def shared_settings(tree: Mapping[str, Any]) -> dict[str, Hashable]:
    """Return the settings by dotted name without those that are FREE."""
    return {name: value for name, value in flattened(tree).items() if name.rpartition(".")[2] not in FREE}


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Hashable]:
    """Return nested settings by dotted name; lists as text."""
    flat: dict[str, Hashable] = {}
    for name, value in tree.items():
        if isinstance(value, str | int | float):  # most values, found quickly
            flat[f"{prefix}{name}"] = value
        elif isinstance(value, Mapping) and value:
            flat |= flattened(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value if isinstance(value, Hashable) else json.dumps(value, default=str)
    return flat


def find_runs(folder: Path) -> Iterator[Path]:
    """Yield `folder` if it is a run, else the runs anywhere below it, in order; runs inside runs are not.

    A failed job of a sweep is a run, so are links that lead nowhere and folders that cannot be read. Links
    are followed, to each folder once.
    """
    seen: set[str] = set()
    unread: list[Path] = []
    walk = os.walk(folder, followlinks=True, onerror=lambda error: unread.append(Path(error.filename)))
    for here, folders, files in walk:
        folders.sort()
        if (real := os.path.realpath(here)) in seen:
            folders.clear()
        elif CONFIG in files or ERROR in files:
            folders.clear()
            yield Path(here)
        else:
            links = (Path(here, name) for name in sorted(files))
            yield from (link for link in links if link.is_symlink() and not link.exists())
        seen.add(real)
    yield from unread


def run_of(agent: Path) -> Path:
    """Return the run folder of an agent: that of its checkpoint if it is one."""
    is_checkpoint = agent.suffix == ".pt" and agent.parent.name == CHECKPOINTS
    return agent.parent.parent if is_checkpoint else agent


def commits_note(runs: Iterable[Run]) -> str:
    """Return a sentence about runs of several commits; empty for one."""
    counts = Counter(run.commit or "no commit" for run in runs)
    if len(counts) < 2:
        return ""
    each = ", ".join(f"{commit} ({count})" for commit, count in counts.most_common())
    return f"The runs are of {len(counts)} commits with the same package versions: {each}."


def short(error: Exception) -> str:
    """Return the text of an error in one line that is not long."""
    return " ".join(str(error).split())[:120] or type(error).__name__
