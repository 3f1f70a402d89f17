"""Reads any set of runs, groups them by the settings that differ, and compares two sets."""

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from glob import glob
from pathlib import Path
from typing import Any

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.grouping import NULL, Columns, fewest, labels, setting_columns
from cartpole_rl.reporting.groups import LONGEST_LABEL
from cartpole_rl.reporting.results import OWN, Agent, Curve, Exclusion, Group, Results
from cartpole_rl.reporting.runs import (
    Run,
    commits_note,
    find_runs,
    learning_curve,
    measured,
    partly_measured_note,
    read_run,
    run_of,
    short,
)
from cartpole_rl.reporting.scores import SCORES
from cartpole_rl.reporting.statistics import interquartile_mean
from cartpole_rl.run_folder import BASELINE, PREFIX

MOST_MEASURES = 20  # in a message
MOST_UNSORTED = 12  # groups that are shown in the order of their runs
AGENT = "agent"  # prefix of the settings of the agent that a run evaluates
MOST_LACKING = 12  # groups that lack seeds, and seeds, that are named one by one
OVERRIDE = re.compile(r"\+{0,2}([a-z_][\w.]*)=")  # on a command line


@dataclass(frozen=True)
class Member:
    """A run of a sweep with the settings that it is grouped by: its own and those of its `agent`.

    `agent` is the run that made the agent which this run evaluates; None if there is no such run. `seeds` are
    those of the agent, of the one that it was fine-tuned from, and so on.
    """

    run: Run
    agent: Run | None
    tree: Mapping[str, Any]
    seeds: tuple[int, ...]

    @property
    def seed(self) -> int:
        """The seed of the training at the end of the chain."""
        return self.seeds[-1]

    @property
    def versions(self) -> str:
        """The versions of the run, and those of its agent where they differ."""
        agent = self.agent.versions if self.agent else self.run.versions
        return self.run.versions if agent == self.run.versions else f"{self.run.versions}, agent {agent}"

    @property
    def problem(self) -> str:
        """Why the run or its agent does not count; empty if both do."""
        of_agent = (
            self.agent and self.agent.problem and f"its agent {self.agent.folder}: {self.agent.problem}"
        )
        return self.run.problem or of_agent or ""


@dataclass(frozen=True)
class Sweep:
    """Runs of one command. `columns` are the settings that differ, `labels` the groups, by member."""

    name: str
    sources: Sequence[str]
    members: Sequence[Member]
    exclusions: Sequence[Exclusion]
    notes: Sequence[str] = ()
    columns: Mapping[str, Sequence[str]] = field(default_factory=dict)
    labels: Sequence[str] = ()


def read_sweeps(sets: Mapping[str, Sequence[str]], measure: str) -> list[Sweep]:
    """Return the runs in the folders and glob patterns of each set, without groups. Raises ConfigError.

    Runs count that are complete, of the most frequent command and of the most frequent versions of all sets.
    A set without any such run keeps its own most frequent ones, with a note.
    """
    agents: dict[Path, Run] = {}
    sweeps = [
        Sweep(name, sources, [_member(read_run(folder), agents) for folder in _folders(name, sources)], ())
        for name, sources in sets.items()
    ]
    sweeps = [_without(sweep, lambda member: member.problem) for sweep in sweeps]
    sweeps = _of_one_kind(sweeps, "commands", lambda member: f"{PREFIX}{member.run.program}")
    sweeps = _of_one_kind(sweeps, "versions", lambda member: member.versions or "unknown")
    _check_measure(sweeps, measure)
    return [_without(sweep, partial(_lack, measure)) for sweep in sweeps]


def _folders(name: str, sources: Sequence[str]) -> list[Path]:
    """Return the runs of all sources, each once, whatever links lead to it. Raises ConfigError."""
    found = [run for source in sources for run in _found(name, source)]
    return [*{os.path.realpath(run): run for run in reversed(found)}.values()][::-1]


def _lack(measure: str, member: Member) -> str:
    return "" if measured(member.run.results, measure) is not None else f"it has no {measure}"


def _without(sweep: Sweep, problem: Callable[[Member], str]) -> Sweep:
    """Return a sweep without the members that have a problem, which it names."""
    reasons = [problem(member) for member in sweep.members]
    kept = [member for member, reason in zip(sweep.members, reasons, strict=True) if not reason]
    left_out = [
        _exclusion(member.run, reason)
        for member, reason in zip(sweep.members, reasons, strict=True)
        if reason
    ]
    return replace(sweep, members=kept, exclusions=[*sweep.exclusions, *left_out])


def _of_one_kind(sweeps: Sequence[Sweep], what: str, kind: Callable[[Member], str]) -> list[Sweep]:
    """Return the sweeps with members of the most frequent kind of all, or of a sweep that has none of it."""
    every = Counter(kind(member) for sweep in sweeps for member in sweep.members)
    common = max(every, key=every.__getitem__, default="")
    found = []
    for sweep in sweeps:
        own = Counter(map(kind, sweep.members))
        kept = common if common in own else max(own, key=own.__getitem__, default=common)
        one = _without(sweep, partial(_difference, what, kind, kept))
        note = f"The {what} of {sweep.name} differ from the rest: {kept}, not {common}."
        found.append(one if kept == common else replace(one, notes=[*sweep.notes, note]))
    return found


def _difference(what: str, kind: Callable[[Member], str], common: str, member: Member) -> str:
    """Return in words that a run is of another kind than most; empty if it is not."""
    own = kind(member)
    return "" if own == common else f"other {what}: {own} instead of {common}"


def grouped(sweeps: Sequence[Sweep]) -> tuple[list[Sweep], Columns]:
    """Return the sweeps with groups of the same labels in each, and the settings that tell sweeps apart.

    The latter map a setting to its value in each sweep, where it has only one.
    """
    members = [member for sweep in sweeps for member in sweep.members]
    columns = setting_columns([each.tree for each in members])
    chosen = {name for member in members for name in _chosen(member.run)}
    bounds = _bounds(sweeps)
    inner = [
        name
        for name, values in columns.items()
        if any(len({*values[start:stop]}) > 1 for start, stop in bounds)
    ]
    outer = fewest({name: columns[name] for name in columns if name not in inner}, chosen)
    between = {
        name: [next(iter(values[start:stop]), NULL) for start, stop in bounds]
        for name, values in outer.items()
    }
    named = _numbered(labels(fewest({name: columns[name] for name in inner}, chosen), len(members)))
    found = [
        replace(
            sweep,
            columns={name: values[start:stop] for name, values in columns.items()},
            labels=named[start:stop],
        )
        for sweep, (start, stop) in zip(sweeps, bounds, strict=True)
    ]
    return found, between


def _numbered(named: Sequence[str]) -> list[str]:
    """Return labels with a number each if figures cut one of them; the number tells them apart there."""
    if not any(len(label) > LONGEST_LABEL for label in named):
        return [*named]
    numbers = {label: number for number, label in enumerate(dict.fromkeys(named), start=1)}
    return [f"{numbers[label]}: {label}" for label in named]


def _chosen(run: Run) -> Iterator[str]:
    """Yield the settings that were given on the command line of a run, with those of its agent's prefix."""
    for word in run.command:
        if match := OVERRIDE.match(word):
            yield match[1]
            yield f"{AGENT}.{match[1]}"


def results_of(sweep: Sweep, measure: str) -> Results:
    """Return the results of a sweep by group, many of them highest first."""
    kept, repeated = without_repetitions(sweep)
    members: dict[str, list[Member]] = {}
    for member, label in kept:
        members.setdefault(label, []).append(member)
    means = {
        label: float(interquartile_mean([_value(each, measure) for each in own]))
        for label, own in members.items()
    }
    ordered = (
        sorted(members, key=means.__getitem__, reverse=True) if len(members) > MOST_UNSORTED else [*members]
    )
    groups = [Group(f"group_{number}", label) for number, label in enumerate(ordered, start=1)]
    curves = {member.run.folder: _curves(member, measure) for member, _ in kept}
    agents = [
        Agent(
            group.name,
            member.seed,
            member.run.folder.as_posix(),
            {OWN.name: _value(member, measure)},
            curves[member.run.folder][0],
        )
        for group in groups
        for member in members[group.label]
    ]
    notes = [
        *sweep.notes,
        commits_note(member.run for member in sweep.members),
        partly_measured_note((member.run for member, _ in kept), measure),
        *_untraced(sweep),
        *_unequal_seeds(sweep),
        *(note for _, note in curves.values()),
    ]
    return Results(
        sweep.name,
        sweep.name,
        measure,
        groups or [Group("none", "no run")],
        tuple(agents),
        (*sweep.exclusions, *repeated),
        tuple(note for note in notes if note),
        sweep.members[0].run.versions if sweep.members else "",
    )


def without_repetitions(sweep: Sweep) -> tuple[list[tuple[Member, str]], list[Exclusion]]:
    """Return the members with their labels without second runs of the same seed, and those runs."""
    kept: dict[tuple[str, tuple[int, ...]], tuple[Member, str]] = {}
    repeated = []
    for member, label in zip(sweep.members, sweep.labels, strict=True):
        if (label, member.seeds) in kept:
            repeated.append(_exclusion(member.run, f"seed {member.seed} of {label} is there twice"))
        else:
            kept[label, member.seeds] = member, label
    return [*kept.values()], repeated


def _value(member: Member, measure: str) -> float:
    value = measured(member.run.results, measure)
    assert value is not None  # `read_sweeps` leaves such runs out
    return value


def _curves(member: Member, measure: str) -> tuple[dict[str, Curve], str]:
    """Return the learning curve of a training, and a note if it is damaged."""
    folder = member.run.folder
    try:
        name, curve = learning_curve(folder, measure)
    except (OSError, ValueError) as error:
        return {}, f"The learning curve of {folder.as_posix()} is not drawn: {short(error)}."
    return ({name: tuple(curve)} if len(curve) > 1 else {}), ""


def _found(name: str, source: str) -> list[Path]:
    """Return the runs of a folder or of a glob pattern. Raises ConfigError if there is none."""
    folders = [Path(source)] if Path(source).is_dir() else [Path(path) for path in sorted(glob(source))]  # noqa: PTH207 - absolute patterns too
    folders = [folder for folder in folders if folder.is_dir() or folder.is_symlink()]
    runs = [run for folder in folders for run in (find_runs(folder) if folder.is_dir() else [folder])]
    if not runs:
        missing = "it holds no run" if folders else "there is no such folder"
        missing += " (in a pattern, [[] stands for a bracket)" if "[" in source and not folders else ""
        raise ConfigError(
            f"{name}={source}: {missing}; give a run folder, a folder that holds some, or a pattern"
        )
    return runs


def _member(run: Run, agents: dict[Path, Run]) -> Member:
    """Return a run with the settings of the agent that it evaluates, if that can be read.

    `agents` are those that were read before.
    """
    tree = {name: value for name, value in run.config.items() if name not in ("run", "evaluated", "repeat")}
    chain = _chain(run, agents)
    if chain:
        tree[AGENT] = _agent_tree((run, *chain))
    elif run.agent:
        tree[AGENT] = {"source": run.agent}
    seeds = tuple(each.seed or 0 for each in chain or [run])
    return Member(run, chain[0] if chain else None, tree, seeds)


def _chain(run: Run, agents: dict[Path, Run]) -> list[Run]:
    """Return the run that made the agent of `run`, the one that this was fine-tuned from, and so on.

    A run that is its own origin occurs once.
    """
    chain: list[Run] = []
    last = run
    while last.agent and (found := _read_agent(last, agents)) and found not in (run, *chain):
        chain.append(found)
        last = found
    return chain


def _read_agent(run: Run, agents: dict[Path, Run]) -> Run | None:
    """Return the run that made the agent of `run`; None if it is not there. `agents` were read before."""
    folder = run_of(Path(run.agent))
    if folder.is_dir():
        agents[folder] = agents.get(folder) or read_run(folder)
    found = agents.get(folder)
    return found if found and found.config else None


def _agent_tree(chain: Sequence[Run]) -> dict[str, Any]:
    """Return the settings of the second run of a chain, the agent of the first, with those of the rest."""
    path, tree = Path(chain[0].agent), dict(chain[1].config)
    if len(chain) > 2:
        tree[AGENT] = _agent_tree(chain[1:])
    return {"checkpoint": path.stem if path.suffix == ".pt" else "last", **tree}


def _bounds(sweeps: Iterable[Sweep]) -> list[tuple[int, int]]:
    """Return the first and the last row (exclusive) of each sweep among the members of all."""
    bounds, start = [], 0
    for sweep in sweeps:
        bounds.append((start, start + len(sweep.members)))
        start += len(sweep.members)
    return bounds


def _unequal_seeds(sweep: Sweep) -> list[str]:
    """Return notes that name the groups that lack seeds which others have."""
    seeds: dict[str, set[int]] = {}
    for member, label in zip(sweep.members, sweep.labels, strict=True):
        seeds.setdefault(label, set()).add(member.seed)
    everything = set().union(*seeds.values())
    lacking = [label for label, own in seeds.items() if own != everything]
    named = [f"{label} lacks {_seeds(everything - seeds[label])}" for label in lacking[:MOST_LACKING]]
    more = len(lacking) - MOST_LACKING
    return named if more <= 0 else [*named, f"{more} more groups lack seeds"]


def _seeds(seeds: set[int]) -> str:
    if len(seeds) > MOST_LACKING:
        return f"{len(seeds)} seeds"
    return f"seed {', '.join(map(str, sorted(seeds)))}"


def _untraced(sweep: Sweep) -> list[str]:
    """Return a note on agents whose own runs are not there."""
    named = {member.run.agent for member in sweep.members if member.agent is None} - {"", str(BASELINE)}
    return [f"The runs of {len(named)} agents were not found and are not checked."] if named else []


def _check_measure(sweeps: Sequence[Sweep], measure: str) -> None:
    """Raise ConfigError if there are runs and none has the measure."""
    results = [member.run.results for sweep in sweeps for member in sweep.members]
    if results and all(measured(each, measure) is None for each in results):
        names = dict.fromkeys(name for each in results for name in _dotted(each))
        ranked = sorted(names, key=lambda name: (name not in SCORES, name.count(".")))
        more = ", ..." if len(ranked) > MOST_MEASURES else ""
        shown = f"{', '.join(ranked[:MOST_MEASURES])}{more}"
        raise ConfigError(f"measure={measure}: no run has it; there are {shown}")


def _dotted(results: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the dotted keys of `measured` that results have."""
    for name, content in results.items():
        if name != "episodes" and measured(results, name) is not None:
            yield f"{prefix}{name}"
        elif isinstance(content, Mapping):
            yield from _dotted(content, f"{prefix}{name}.")


def _exclusion(run: Run, reason: str) -> Exclusion:
    return Exclusion(run.folder.as_posix(), reason)
