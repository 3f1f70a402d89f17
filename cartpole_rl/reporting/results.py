"""The agents of several groups as plain numbers: what the tables and figures of a report show.

A measure is a key of metrics.json; the number of an agent is its mean over the episodes of an evaluation.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, get_args

import numpy as np

from cartpole_rl.reporting import texts
from cartpole_rl.reporting.statistics import Array, Estimate, estimate
from cartpole_rl.reporting.texts import MOST_DECIMALS, count_text, interval_text, number_text
from cartpole_rl.tasks.settings import Measure

THESIS_PERIODS = 500  # of an episode of 10 s, 20 ms each
GOOD = {"score": 2000.0}  # measure: value above which the thesis calls an agent good (section 6)
MEASURES = {  # key of metrics.json: label
    **texts.SCORES,
    "score_upright": "score (6.1)",
    "upright_at_end": "share upright at the end",
    "errors.median": "median relative error of the parameters",
    "network_over_physics.theta_deg": "error of the angle, with / without network",
}
LOW_IS_GOOD = (  # starts of measures
    *("errors", "rms_", "time_to_", "network_over_", "guarded_fraction", "motor_reversals_per_s"),
    *("late_ticks", "lost_frames", "bad_frames", "ended_by.", "falls", "recovery_"),
    *("held_out_1_s.", "residual.", "candidates.", "standard_errors."),  # of an identification
)
SCORES = get_args(Measure)
SCORE_DECIMALS = 1  # at most
LARGEST = 1e30  # of all numbers; figures and means of larger ones overflow
EVALUATIONS = "evaluations"  # folder in that of an agent
PLAIN = re.compile(r"[A-Za-z' -]+")  # labels that need no quotation marks
MOST_LISTED = 4  # groups in a sentence; of more, the highest and the lowest

Curve = tuple[tuple[float, float], ...]  # (transitions, value)


class Named(Protocol):
    """A group of agents or an evaluation: its key, and its label on the page."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def label(self) -> str: ...  # noqa: D102


@dataclass(frozen=True)
class Group:
    """A group of agents, or an evaluation of them."""

    name: str
    label: str


OWN = Group("own", "its own evaluation")  # the result of a run without further evaluations


@dataclass(frozen=True)
class Agent:
    """One run of a group. `values` maps evaluations to the measure; `curves` are those of its training.

    `behaviour` maps evaluations to further means over the episodes, by their keys in metrics.json. `seeds`
    are those of the runs that made the agent, the last one first; `source` is the run that it starts from, or
    the hash or the name of an agent without a run.
    """

    group: str
    seed: int
    run: str  # relative path
    values: Mapping[str, float]
    curves: Mapping[str, Curve] = field(default_factory=dict)
    behaviour: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    folders: Mapping[str, str] = field(default_factory=dict)  # of evaluations that are elsewhere
    seeds: tuple[int, ...] | None = None  # None: `seed` alone
    source: str = ""

    @property
    def seed_text(self) -> str:
        """The seeds for people, see `seeds_text`."""
        return seeds_text((self.seed,) if self.seeds is None else self.seeds)


@dataclass(frozen=True)
class Exclusion:
    """A run that does not count, and the reason."""

    run: str
    reason: str


@dataclass(frozen=True)
class Results:
    """The agents that count, by group and evaluation, the runs that do not, and notes on all runs."""

    name: str
    title: str
    measure: str
    groups: Sequence[Named]
    agents: tuple[Agent, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    notes: tuple[str, ...] = ()
    versions: str = ""  # of the packages that all agents share
    evaluations: Sequence[Named] = (OWN,)
    unit: str = "agent"  # what a run makes
    pictured: bool = False  # the results of the runs are figures
    periods: int | None = THESIS_PERIODS  # control periods of the episodes of 10 s; None: not all are such

    @property
    def good(self) -> float | None:
        """The value above which an agent is good: a score is a sum over `periods`."""
        good = GOOD.get(self.measure)
        return None if good is None or self.periods is None else good * self.periods / THESIS_PERIODS

    @property
    def judged(self) -> Sequence[Named]:
        """The evaluations that count."""
        return self.evaluations[-1:]

    def values(self, group: str, evaluation: str) -> Array:
        """Return the measure of each agent of a group [agents]."""
        return np.array(
            [agent.values[evaluation] for agent in self.members(group) if evaluation in agent.values]
        )

    def members(self, group: str) -> list[Agent]:
        """Return the agents of a group."""
        return self._members.get(group, [])

    @cached_property
    def _members(self) -> dict[str, list[Agent]]:
        found: dict[str, list[Agent]] = {}
        for agent in self.agents:
            found.setdefault(agent.group, []).append(agent)
        return found

    def estimates(self, evaluation: str) -> dict[str, Estimate]:
        """Return the interquartile mean of each group (by label) that has agents in an evaluation."""
        found = {each.label: self.values(each.name, evaluation) for each in self.groups}
        return {label: estimate(values) for label, values in found.items() if values.size}

    def folder_of(self, agent: Agent, evaluation: str) -> Path:
        """Return the folder of an evaluation of an agent; that of its own run if it has no others."""
        if evaluation in agent.folders:
            return Path(agent.folders[evaluation])
        inner = Path(agent.run, EVALUATIONS, evaluation)
        return Path(agent.run) if evaluation == OWN.name and not inner.is_dir() else inner


def seeds_text(seeds: Sequence[int]) -> str:
    """Return the seeds of the runs that made an agent: "2", or "0 (agent 10)" of a fine-tuned one."""
    first, rest = [*map(str, seeds[:1])], [f"(agent {seed})" for seed in seeds[1:]]
    return " ".join([*first, *rest]) or "–"


def is_number(value: Any) -> bool:
    """Return True for a finite number that figures can show; a boolean is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def low_is_good(measure: str) -> bool:
    """Return True for a measure of which less is better."""
    return measure.startswith(LOW_IS_GOOD) and measure != "ended_by.time"


def measure_label(measure: str) -> str:
    """Return the name of a measure for axes and tables."""
    return MEASURES.get(measure, measure.replace("_", " ").replace(".", " "))


def estimate_text(found: Estimate, measure: str = "") -> str:
    """Return an estimate with its interval: "4210 (4125 to 4295)"."""
    return interval_text(found.value, found.low, found.high, ends=True, most_decimals=_decimals(measure))


def value_text(value: float, measure: str) -> str:
    """Return a value of a measure: "4210"."""
    return number_text(value, _decimals(measure))


def _decimals(measure: str) -> int:
    return SCORE_DECIMALS if measure in SCORES else MOST_DECIMALS


def sentence_start(text: str) -> str:
    """Return a text with a capital letter at its start."""
    return text[:1].upper() + text[1:]


def ranked_text(found: Mapping[str, Estimate], unit: str = "agent", measure: str = "") -> str:
    """Return ": " and the estimate of each group, the best first; of many the highest and the lowest."""
    less = low_is_good(measure)
    note = " (lower is better)" if less else ""
    labels = sorted(found, key=lambda label: found[label].value, reverse=not less)
    best = found[labels[0]]
    same_count = all(each.agents == best.agents for each in found.values())
    if same_count and len({estimate_text(each, measure) for each in found.values()}) == 1:
        each = "" if len(labels) == 1 else f"each of {len(labels)} set-ups "
        return f"{note}: {each}{estimate_text(best, measure)}, {count_text(best.agents, unit)}"

    def entry(label: str) -> str:
        count = "" if same_count else f" of {count_text(found[label].agents, unit)}"
        name = label if PLAIN.fullmatch(label) else f"“{label}”"
        return f"{name} {estimate_text(found[label], measure)}{count}"

    end = f"; {count_text(best.agents, unit)} each" if same_count else ""
    first, last = ("lowest", "highest") if less else ("highest", "lowest")
    if len(labels) <= MOST_LISTED:
        return f"{note}: {', '.join(map(entry, labels))}{end}"
    return f"{note}, {len(labels)} set-ups: {first} {entry(labels[0])}, {last} {entry(labels[-1])}{end}"
