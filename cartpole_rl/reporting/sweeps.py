"""Reads any set of runs, groups them by the settings that differ, and compares two sets."""

import math
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from glob import glob
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.grouping import AGENT, NULL, SOURCE, Columns, fewest, labels, setting_columns
from cartpole_rl.reporting.groups import LONGEST_LABEL, MOST_LINES
from cartpole_rl.reporting.results import (
    OWN,
    THESIS_PERIODS,
    Agent,
    Curve,
    Exclusion,
    Group,
    Results,
    seeds_text,
)
from cartpole_rl.reporting.runs import (
    DAMAGE,
    EPISODIC,
    Run,
    commits_note,
    find_runs,
    learning_curve,
    measured,
    partly_measured_note,
    place_of_agent,
    read_run,
    run_of,
    short,
)
from cartpole_rl.reporting.statistics import interquartile_mean
from cartpole_rl.reporting.texts import SCORES, count_text
from cartpole_rl.run_folder import (
    AGENT_HASH,
    BASELINE,
    CART,
    COMPARISON,
    POLE,
    PREFIX,
    PRETRAINED,
    RANDOMIZATION,
    USES,
    is_own_policy,
)

SECONDS = 10.0  # of an episode of the thesis
MOST_MEASURES = 20  # in a message
MOST_UNSORTED = 12  # groups that are shown in the order of their runs
STAGES = ("before", "after")  # of a fine-tuning
IDENTIFIED_FILES = (CART, POLE, RANDOMIZATION)
TITLES = {
    **{"train": "Trainings", "finetune": "Fine-tunings", "distill": "Distillations"},
    **{"evaluate": "Evaluations", "record": "Recordings", "identify": "Identifications", "model": "Models"},
}
MOST_LACKING = 12  # groups that lack seeds, seeds, and rejected fine-tunings, that are named one by one
OVERRIDE = re.compile(r"\+{0,2}([a-z_][\w.]*)=(.*)")  # on a command line


@dataclass(frozen=True)
class Member:
    """A run of a sweep with the settings that it is grouped by: its own and those of its `agent`.

    `agent` is the run that made the agent which this run starts from; None if there is no such run. `seeds`
    are those of the run that made the agent, of the one that it was fine-tuned from, and so on; a pretrained
    agent has none.
    """

    run: Run
    agent: Run | None
    tree: Mapping[str, Any]
    seeds: tuple[int, ...]

    @property
    def seed(self) -> int:
        """The seed of the training at the end of the chain."""
        return (0, *self.seeds)[-1]

    @property
    def agent_key(self) -> tuple[Any, ...]:
        """The key of its agent in its group: the seeds, and the source if its run is lost."""
        return self.seeds if self.agent or not self.run.agent else (*self.seeds, self.source)

    @property
    def source(self) -> str:
        """The run that the run starts from, or itself; the hash or the name of an agent without a run."""
        if self.agent is None and self.run.agent:
            return self.run.provenance.get(AGENT_HASH) or self.run.agent
        return os.path.realpath((self.agent or self.run).folder)

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


Kept = tuple[Member, str, str]  # with the labels of its group and of its evaluation


@dataclass(frozen=True)
class Sweep:
    """Runs of one command.

    `columns` are the settings that differ, `labels` the groups, `evaluations` what sets evaluations of the
    same agent apart, by member.
    """

    name: str
    members: Sequence[Member]
    exclusions: Sequence[Exclusion]
    notes: Sequence[str] = ()
    columns: Mapping[str, Sequence[str]] = field(default_factory=dict)
    labels: Sequence[str] = ()
    evaluations: Sequence[str] = ()


def read_groups(sets: Mapping[str, Sequence[str]], measure: str) -> tuple[list[Sweep], Columns | None]:
    """Return the runs of each set in groups, and what tells two sets apart. Raises ConfigError.

    A single set has a sweep for each command.
    """
    sweeps = read_sweeps(sets, measure)
    if len(sets) > 1:
        return grouped(sweeps)
    return [one for sweep in sweeps for one in grouped([sweep])[0]], None


def read_sweeps(sets: Mapping[str, Sequence[str]], measure: str) -> list[Sweep]:
    """Return the runs in the folders and glob patterns of each set, without groups. Raises ConfigError.

    Runs count that are complete, and of the most frequent versions of all sets. Of two sets those of the most
    frequent command count; a single set has a sweep for each command. A set without any such run keeps its
    own most frequent ones, with a note.
    """
    agents: dict[Path, Run] = {}
    sweeps = [
        Sweep(name, [_member(read_run(folder), agents) for folder in _folders(name, sources)], ())
        for name, sources in sets.items()
    ]
    sweeps = [_without(sweep, lambda member: member.problem) for sweep in sweeps]
    if len(sweeps) > 1:
        sweeps = _of_one_kind(sweeps, "commands", lambda member: f"{PREFIX}{member.run.program}")
    else:
        sweeps = _by_command(sweeps[0])
    sweeps = _of_one_kind(sweeps, "versions", lambda member: member.versions or "unknown")
    _check_measure(sweeps, measure)
    return [_without(sweep, partial(_lack, measure)) for sweep in sweeps]


def _by_command(sweep: Sweep) -> list[Sweep]:
    """Return a sweep for each command; the first one names all runs that do not count."""
    members: dict[str, list[Member]] = {}
    for member in sweep.members:
        members.setdefault(member.run.program, []).append(member)
    ordered = sorted(members, key=lambda program: [*USES, program].index(program))
    return [
        replace(sweep, name=program, members=members[program], exclusions=() if number else sweep.exclusions)
        for number, program in enumerate(ordered)
    ] or [sweep]


def _folders(name: str, sources: Sequence[str]) -> list[Path]:
    """Return the runs of all sources, each once, whatever links lead to it. Raises ConfigError."""
    found = [run for source in sources for run in _found(name, source)]
    return [*{os.path.realpath(run): run for run in reversed(found)}.values()][::-1]


def _lack(measure: str, member: Member) -> str:
    return "" if measured(member.run.results, measure) is not None else f"it has no {measure}"


def _without(sweep: Sweep, problem: Callable[[Member], str]) -> Sweep:
    """Return a sweep without the members that have a problem, which it names."""
    judged = [(member, problem(member)) for member in sweep.members]
    kept = [member for member, reason in judged if not reason]
    left_out = [_exclusion(member.run, reason) for member, reason in judged if reason]
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
    given = [dict(_given(member)) for member in members]
    columns = setting_columns([each.tree for each in members], [_words(each) for each in given])
    chosen = {SOURCE, *(name for each in given for name in each)}
    bounds = [*pairwise(accumulate((len(sweep.members) for sweep in sweeps), initial=0))]
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
    evaluates = any(member.agent or member.run.agent for member in members)
    named, evaluations = _named(
        {name: columns[name] for name in inner}, chosen, len(members), evaluates and len(sweeps) == 1
    )
    found = [
        replace(
            sweep,
            columns={name: values[start:stop] for name, values in columns.items()},
            labels=named[start:stop],
            evaluations=evaluations[start:stop],
        )
        for sweep, (start, stop) in zip(sweeps, bounds, strict=True)
    ]
    return found, between


def _named(
    columns: Columns, chosen: Collection[str], count: int, split: bool
) -> tuple[Sequence[str], Sequence[str]]:
    """Return the label of each run's group, and that of its evaluation if `split` and these are few."""
    of_agent = {name: each for name, each in columns.items() if name.startswith((f"{AGENT}.", SOURCE))}
    own = {name: each for name, each in columns.items() if name not in of_agent}
    evaluations = labels(fewest(own, chosen), count)
    if split and own and of_agent and len({*evaluations}) <= MOST_LINES:
        return _numbered(labels(fewest(of_agent, chosen), count)), evaluations
    return _numbered(labels(fewest(columns, chosen), count)), [""] * count


def _numbered(named: Sequence[str]) -> list[str]:
    """Return labels with a number each if figures cut one of them; the number tells them apart there."""
    if not any(len(label) > LONGEST_LABEL for label in named):
        return [*named]
    numbers = {label: number for number, label in enumerate(dict.fromkeys(named), start=1)}
    return [f"{numbers[label]}: {label}" for label in named]


def _given(member: Member) -> Iterator[tuple[str, str]]:
    """Yield the settings on the command lines of a run and of its agent, with their values."""
    for prefix, run in (("", member.run), (f"{AGENT}.", member.agent)):
        for match in map(OVERRIDE.match, run.command if run else ()):
            if match:
                yield f"{prefix}{match[1]}", match[2]


def _words(given: Mapping[str, str]) -> dict[str, str]:
    """Return a word for each group that was given as a file: "identified", or the name of the file."""
    paths = {name: Path(value) for name, value in given.items() if value.endswith(".yaml")}
    return {
        name: "identified" if path.name in IDENTIFIED_FILES else path.stem for name, path in paths.items()
    }


def results_of(sweep: Sweep, measure: str) -> Results:
    """Return the results of a sweep by group, many of them highest first."""
    kept, repeated = without_repetitions(sweep)
    curves = {member.run.folder: _curves(member, measure) for member, _, _ in kept}
    agents = _agents(kept, measure, {folder: curve for folder, (curve, _) in curves.items()})
    groups, ordered = _ordered(agents)
    evaluations = dict.fromkeys(name for agent in agents for name in agent.values)
    notes = [
        *sweep.notes,
        commits_note(member.run for member in sweep.members),
        partly_measured_note((member.run for member, _, _ in kept), measure),
        *_untraced(sweep),
        *_unequal_seeds(sweep),
        _rejected([member.run.folder.as_posix() for member, _, _ in kept if member.run.kept == STAGES[0]]),
        *(note for _, note in curves.values()),
    ]
    return Results(
        sweep.name,
        TITLES.get(sweep.name, sweep.name),
        measure,
        groups or [Group("none", "no run")],
        tuple(ordered),
        (*sweep.exclusions, *repeated),
        tuple(note for note in notes if note),
        sweep.members[0].run.versions if sweep.members else "",
        [OWN if name == OWN.name else Group(name, name) for name in evaluations] or [OWN],
        periods=_periods(sweep.members),
    )


def _periods(members: Sequence[Member]) -> int | None:
    """Return the control periods of the episodes, where all of them last as long as the thesis's."""
    found: set[int | None] = set()
    for member in members:
        with suppress(*DAMAGE):  # a run without them, as many a fine-tuning, has the usual ones
            settings: Any = member.run.config.get("evaluated") or (member.agent or member.run).config
            task, period = settings["task"], settings["control_period"]
            limit = task.get("time_limit") or task["duration"] / period
            found.add(round(limit) if math.isclose(limit * period, SECONDS, rel_tol=0.01) else None)
    return found.pop() if len(found) == 1 else None if found else THESIS_PERIODS


def _agents(kept: Sequence[Kept], measure: str, curves: Mapping[Path, Mapping[str, Curve]]) -> list[Agent]:
    """Return each agent with its evaluations; its group is the label."""
    found: dict[tuple[str, tuple[Any, ...]], dict[str, Member]] = {}
    for member, label, evaluation in kept:
        found.setdefault((label, member.agent_key), {})[evaluation or OWN.name] = member
    return [
        Agent(
            label,
            first.seed,
            ", ".join(member.run.folder.as_posix() for member in own.values()),
            {name: value for each, member in own.items() for name, value in _values(each, member, measure)},
            curves[first.run.folder],
            folders={
                name: member.run.folder.as_posix()
                for each, member in own.items()
                for name in (each, member.run.kept)  # a fine-tuning has pictures of the policy that it kept
                if name
            },
            seeds=first.seeds,
            source=first.source,
        )
        for (label, _), own in found.items()
        for first in [next(iter(own.values()))]
    ]


def _ordered(agents: Sequence[Agent]) -> tuple[list[Group], list[Agent]]:
    """Return the groups of agents, many of them highest first, and the agents in their order."""
    members: dict[str, list[Agent]] = {}
    for agent in agents:
        members.setdefault(agent.group, []).append(agent)
    means = {
        label: float(interquartile_mean([value for agent in own for value in agent.values.values()]))
        for label, own in members.items()
    }
    many = len(members) > MOST_UNSORTED
    ordered = sorted(members, key=means.__getitem__, reverse=True) if many else [*members]
    groups = [Group(f"group_{number}", label) for number, label in enumerate(ordered, start=1)]
    return groups, [replace(agent, group=group.name) for group in groups for agent in members[group.label]]


def without_repetitions(sweep: Sweep) -> tuple[list[Kept], list[Exclusion]]:
    """Return the members with their labels and evaluations without second runs of a seed, and those runs."""
    kept: dict[tuple[str, str, tuple[Any, ...]], Kept] = {}
    repeated = []
    for member, label, evaluation in zip(sweep.members, sweep.labels, sweep.evaluations, strict=True):
        if (label, evaluation, member.agent_key) in kept:
            which = f"seed {seeds_text(member.seeds)}" if member.seeds else "the agent"
            repeated.append(_exclusion(member.run, f"{which} of {label} is there twice"))
        else:
            kept[label, evaluation, member.agent_key] = member, label, evaluation
    return [*kept.values()], repeated


def _values(evaluation: str, member: Member, measure: str) -> Iterator[tuple[str, float]]:
    """Yield the measure in each evaluation of a run: a fine-tuning has one before and one after."""
    results = member.run.results.get(Path(COMPARISON).stem) or {}
    stages = {stage: measured(results, f"{stage}.{measure}") for stage in STAGES}
    if all(value is not None for value in stages.values()):
        yield from ((stage, value) for stage, value in stages.items() if value is not None)
    else:
        value = measured(member.run.results, measure)
        assert value is not None  # `read_sweeps` leaves such runs out
        yield evaluation, value


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
        absent = "it is a file" if Path(source).is_file() else "there is no such folder"
        missing = "it holds no run" if folders else absent
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
        tree[SOURCE] = run.agent
    # the seed of a lost agent is not known
    made_by = chain if run.program in EPISODIC and _is_trained(run) else [run, *chain]
    return Member(run, chain[0] if chain else None, tree, tuple(each.seed or 0 for each in made_by))


def _is_trained(run: Run) -> bool:
    """Return True for a run that starts from a trained agent."""
    return run.agent not in ("", str(BASELINE)) and not is_own_policy(Path(run.agent))


def _chain(run: Run, agents: dict[Path, Run]) -> list[Run]:
    """Return the run that made the agent of `run`, the one that this was fine-tuned from, and so on.

    A run that is its own origin occurs once. `agents` were read before.
    """
    chain: list[Run] = []
    last = run
    while last.agent:
        folder = run_of(place_of_agent(last))
        if folder not in agents and folder.is_dir():
            agents[folder] = read_run(folder)
        found = agents.get(folder)
        known = {os.path.realpath(each.folder) for each in (run, *chain)}
        if not found or not found.config or os.path.realpath(found.folder) in known:
            break
        chain.append(found)
        last = found
    return chain


def _agent_tree(chain: Sequence[Run]) -> dict[str, Any]:
    """Return the settings of the second run of a chain, the agent of the first, with those of the rest."""
    path, tree = Path(chain[0].agent), dict(chain[1].config)
    if len(chain) > 2:
        tree[AGENT] = _agent_tree(chain[1:])
    return {"checkpoint": path.stem if path.suffix == ".pt" else "last", **tree}


def _unequal_seeds(sweep: Sweep) -> list[str]:
    """Return notes that name the groups that lack seeds which others have."""
    seeds: dict[str, set[int]] = {}
    for member, label in zip(sweep.members, sweep.labels, strict=True):
        if member.seeds:
            seeds.setdefault(label, set()).add(member.seed)
    everything = set().union(*seeds.values())
    lacking = [label for label, own in seeds.items() if own != everything]
    named = [f"{label} lacks {_seeds(everything - seeds[label])}" for label in lacking[:MOST_LACKING]]
    more = len(lacking) - MOST_LACKING
    return named if more <= 0 else [*named, f"{more} more groups lack seeds"]


def _rejected(runs: Sequence[str]) -> str:
    """Return a note on fine-tunings that kept the policy before them; empty without any."""
    more = [f"{len(runs) - MOST_LACKING} more"] if len(runs) > MOST_LACKING else []
    named = ", ".join([*runs[:MOST_LACKING], *more])
    note = (
        f'Rejected fine-tunings: {named}. Their "after" is the policy that was discarded for the one before.'
    )
    return note if runs else ""


def _seeds(seeds: set[int]) -> str:
    if len(seeds) > MOST_LACKING:
        return f"{len(seeds)} seeds"
    return f"seed {', '.join(map(str, sorted(seeds)))}"


def _untraced(sweep: Sweep) -> list[str]:
    """Return a note on agents whose own runs are not there."""
    named = [member for member in sweep.members if not member.agent and _is_trained(member.run)]
    lost = {member.source for member in named if Path(member.run.agent).parts[:1] != (PRETRAINED,)}
    count = count_text(len(lost), "agent")
    return [f"The runs of {count} were not found and are not checked."] if lost else []


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
