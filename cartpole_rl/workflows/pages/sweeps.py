"""Reads any set of runs, groups them by the settings that differ, and compares two sets."""

import csv
import io
import re
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from glob import glob
from pathlib import Path
from typing import Any

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.figures.studies import LONGEST_LABEL
from cartpole_rl.reporting.studies.grouping import NULL, Columns, fewest, labels, setting_columns
from cartpole_rl.reporting.studies.results import OWN, Agent, Curve, Exclusion, StudyResults
from cartpole_rl.reporting.studies.settings import Size, Study, Variant
from cartpole_rl.reporting.studies.statistics import interquartile_mean
from cartpole_rl.run_files import CHECKPOINTS
from cartpole_rl.workflows.pages.runs import (
    Run,
    commits_note,
    find_runs,
    learning_curve,
    measured,
    read_run,
    shared_settings,
    split_by_majority,
)
from cartpole_rl.workflows.run_folder import PREFIX

MOST_UNSORTED = 12  # groups that are shown in the order of their runs
AGENT = "agent"  # prefix of the settings of the agent that a run evaluates
OVERRIDE = re.compile(r"\+{0,2}([a-z_][\w.]*)=")  # on a command line


@dataclass(frozen=True)
class Member:
    """A run of a sweep with the settings that it is grouped by: its own and those of its agent."""

    run: Run
    tree: Mapping[str, Any]
    settings: Mapping[str, Hashable]
    seed: int


@dataclass(frozen=True)
class Sweep:
    """Runs of one command. `columns` are the settings that differ, `labels` the groups, by member."""

    name: str
    sources: Sequence[str]
    members: Sequence[Member]
    exclusions: Sequence[Exclusion]
    columns: Mapping[str, Sequence[str]] = field(default_factory=dict)
    labels: Sequence[str] = ()


def read_sweep(name: str, sources: Sequence[str], measure: str) -> Sweep:
    """Return the runs in the folders and glob patterns `sources`, without groups. Raises ConfigError.

    Runs count that are complete, of the most frequent command and of the most frequent versions.
    """
    folders = dict.fromkeys(run for source in sources for run in _found(name, source))
    runs = [read_run(folder) for folder in folders]
    exclusions = [_exclusion(run, run.problem) for run in runs if run.problem]
    usable, others = split_by_majority([run for run in runs if not run.problem], lambda run: run.program)
    exclusions += [
        _exclusion(run, f"a run of {PREFIX}{run.program} among runs of {PREFIX}{common}")
        for run, common in others
    ]
    usable, others = split_by_majority(usable, lambda run: run.versions)
    exclusions += [
        _exclusion(run, f"other versions: {run.versions or 'unknown'} instead of {common}")
        for run, common in others
    ]
    unmeasured = [run for run in usable if measured(run.results, measure) is None]
    exclusions += [_exclusion(run, f"it has no {measure}") for run in unmeasured]
    agents: dict[Path, Run] = {}
    return Sweep(name, sources, [_member(run, agents) for run in usable if run not in unmeasured], exclusions)


def grouped(sweeps: Sequence[Sweep]) -> tuple[list[Sweep], Columns]:
    """Return the sweeps with groups of the same labels in each, and the settings that tell sweeps apart.

    The latter map a setting to its value in each sweep, where it has only one.
    """
    members = [member for sweep in sweeps for member in sweep.members]
    columns = setting_columns([each.tree for each in members], [each.settings for each in members])
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
    named = labels(fewest({name: columns[name] for name in inner}, chosen), len(members))
    found = [
        replace(
            sweep,
            columns={name: values[start:stop] for name, values in columns.items()},
            labels=named[start:stop],
        )
        for sweep, (start, stop) in zip(sweeps, bounds, strict=True)
    ]
    return found, between


def _chosen(run: Run) -> Iterator[str]:
    """Yield the settings that were given on the command line of a run, with those of its agent's prefix."""
    for word in run.provenance.get("command") or ():
        if match := OVERRIDE.match(str(word)):
            yield match[1]
            yield f"{AGENT}.{match[1]}"


def results_of(sweep: Sweep, measure: str) -> StudyResults:
    """Return a sweep as the results of a study whose arms are its groups, many of them highest first."""
    kept, repeated = _without_repetitions(sweep)
    groups: dict[str, list[Member]] = {}
    for member, label in kept:
        groups.setdefault(label, []).append(member)
    means = {
        label: float(interquartile_mean([_value(each, measure) for each in own]))
        for label, own in groups.items()
    }
    ordered = (
        sorted(groups, key=means.__getitem__, reverse=True) if len(groups) > MOST_UNSORTED else [*groups]
    )
    arms = [Variant(name=f"group_{number}", label=label) for number, label in enumerate(ordered, start=1)]
    if any(len(label) > LONGEST_LABEL for label in ordered):  # figures cut them: a number tells them apart
        arms = [
            arm.model_copy(update={"label": f"{number}: {arm.label}"})
            for number, arm in enumerate(arms, start=1)
        ]
    agents = [
        Agent(
            arm.name,
            member.seed,
            member.run.folder.as_posix(),
            {OWN.name: _value(member, measure)},
            _curves(member, measure),
        )
        for arm, label in zip(arms, ordered, strict=True)
        for member in groups[label]
    ]
    notes = [commits_note(member.run for member in sweep.members), *_unequal_seeds(sweep)]
    return StudyResults(
        sweep.name,
        Study(
            title=sweep.name,
            order=0,
            question="",
            measure=measure,
            arms=tuple(arms) or (Variant(name="none", label="no run"),),
            sizes={"any": Size(seeds=1)},
        ),
        tuple(agents),
        (*sweep.exclusions, *repeated),
        tuple(note for note in notes if note),
        sweep.members[0].run.versions if sweep.members else "",
    )


def _without_repetitions(sweep: Sweep) -> tuple[list[tuple[Member, str]], list[Exclusion]]:
    """Return the members with their labels without second runs of the same seed, and those runs."""
    kept: dict[tuple[str, int], tuple[Member, str]] = {}
    repeated = []
    for member, label in zip(sweep.members, sweep.labels, strict=True):
        if (label, member.seed) in kept:
            repeated.append(_exclusion(member.run, f"seed {member.seed} of {label} is there twice"))
        else:
            kept[label, member.seed] = member, label
    return [*kept.values()], repeated


def _value(member: Member, measure: str) -> float:
    value = measured(member.run.results, measure)
    assert value is not None  # `read_sweep` leaves such runs out
    return value


def _curves(member: Member, measure: str) -> dict[str, Curve]:
    """Return the learning curve of a training."""
    name, curve = learning_curve(member.run.folder, measure)
    return {name: tuple(curve)} if len(curve) > 1 else {}


def table(sweeps: Sequence[Sweep]) -> str:
    """Return all runs as CSV: their group, differing settings and mean metrics, or why one is left out."""
    rows: list[dict[str, Any]] = []
    for sweep in sweeps:
        repeated = {each.run: each.reason for each in _without_repetitions(sweep)[1]}
        for number, (member, label) in enumerate(zip(sweep.members, sweep.labels, strict=True)):
            chosen = {f"setting:{name}": values[number] for name, values in sweep.columns.items()}
            head = {
                "set": sweep.name,
                "run": member.run.folder.as_posix(),
                "command": member.run.program,
                "group": label,
                "seed": member.seed,
                "left_out": repeated.get(member.run.folder.as_posix(), ""),
            }
            rows.append({**head, **chosen, **_means(member.run.results)})
        rows += [{"set": sweep.name, "run": each.run, "left_out": each.reason} for each in sweep.exclusions]
    names = dict.fromkeys(name for row in rows for name in row)
    text = io.StringIO()
    writer = csv.DictWriter(text, [*names], restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _found(name: str, source: str) -> list[Path]:
    """Return the runs of a folder or of a glob pattern. Raises ConfigError if there is none."""
    folders = [Path(source)] if Path(source).is_dir() else [Path(path) for path in sorted(glob(source))]  # noqa: PTH207 - absolute patterns too
    runs = [run for folder in folders if folder.is_dir() for run in find_runs(folder)]
    if not runs:
        missing = "it holds no run" if folders else "there is no such folder"
        raise ConfigError(
            f"{name}={source}: {missing}; give a run folder, a folder that holds some, or a pattern"
        )
    return runs


def _member(run: Run, agents: dict[Path, Run]) -> Member:
    """Return a run with the settings of the agent that it evaluates, if that can be read."""
    tree = {name: value for name, value in run.config.items() if name not in ("run", "evaluated", "repeat")}
    seed = run.seed
    if source := run.config.get("run"):
        folder, checkpoint = Path(source), "last"
        if folder.suffix == ".pt":
            folder, checkpoint = (
                folder.parent.parent if folder.parent.name == CHECKPOINTS else folder,
                folder.stem,
            )
        agent = agents.setdefault(folder, read_run(folder))
        if agent.config:
            tree[AGENT] = {"checkpoint": checkpoint, **agent.config}
            seed = agent.seed
        else:
            tree[AGENT] = {"source": str(source)}
    return Member(run, tree, shared_settings(tree), seed if seed is not None else 0)


def _bounds(sweeps: Iterable[Sweep]) -> list[tuple[int, int]]:
    """Return the first and the last row (exclusive) of each sweep among the members of all."""
    bounds, start = [], 0
    for sweep in sweeps:
        bounds.append((start, start + len(sweep.members)))
        start += len(sweep.members)
    return bounds


def _unequal_seeds(sweep: Sweep) -> list[str]:
    """Return a note that names the groups that lack seeds which others have."""
    seeds: dict[str, set[int]] = {}
    for member, label in zip(sweep.members, sweep.labels, strict=True):
        seeds.setdefault(label, set()).add(member.seed)
    everything = set().union(*seeds.values())
    shared = [own for own in seeds.values() if own == everything]
    if len(seeds) < 2 or not shared:
        return []
    return [
        f"{label} lacks seed {', '.join(map(str, sorted(everything - own)))}"
        for label, own in seeds.items()
        if own != everything
    ]


def _means(results: Mapping[str, Any]) -> dict[str, float]:
    """Return every number among the results, the mean where a metric has one."""
    return {
        name: value
        for name in results
        if name != "episodes" and (value := measured(results, name)) is not None
    }


def _exclusion(run: Run, reason: str) -> Exclusion:
    return Exclusion(run.folder.as_posix(), reason)
