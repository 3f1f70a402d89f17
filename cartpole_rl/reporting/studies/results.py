"""The results of a study as plain numbers, read from run folders or from a small JSON file."""

import hashlib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from cartpole_rl.reporting.studies.settings import RUNS, SEED, Finding, FolderName, Size, Study, Variant
from cartpole_rl.reporting.studies.statistics import Estimate, estimate

FORMAT = 1  # of the JSON file
DIGITS = 6  # significant, of the numbers in it
DIGEST = 8  # hex digits
OWN = Variant(name="own", label="its own evaluation")  # the result of a run without further evaluations
STAGES = (Variant(name="before", label="before"), Variant(name="after", label="after fine-tuning"))

CART = "emulated"  # evaluation on the cart that stands for the real one
LARGEST = 1e30  # of all numbers; figures and means of larger ones overflow
NAME: TypeAdapter[str] = TypeAdapter(FolderName)
MOST_LACKING = 5  # seeds that are named one by one
SMALLEST = 0.1  # share of the study's highest value, below which an agent has no ratio

Array = NDArray[np.float64]
Curve = tuple[tuple[float, float], ...]  # (transitions, value)


@dataclass(frozen=True)
class Agent:
    """One run of an arm. `values` maps evaluations to the measure; `curves` are those of its training."""

    arm: str
    seed: int
    run: str  # relative path
    values: Mapping[str, float]
    curves: Mapping[str, Curve] = field(default_factory=dict)


@dataclass(frozen=True)
class Exclusion:
    """A run that does not count, and the reason."""

    run: str
    reason: str


@dataclass(frozen=True)
class StudyResults:
    """The agents of a study that count, the runs that do not, and remarks on how they were made.

    A `shipped` study is one of conf/study/; `changed` names what today's file there has made otherwise.
    """

    name: str
    study: Study
    agents: tuple[Agent, ...] = ()
    exclusions: tuple[Exclusion, ...] = ()
    notes: tuple[str, ...] = ()
    versions: str = ""  # of the packages that all agents share
    folder: str = ""  # relative path of the runs
    shipped: bool = False
    changed: tuple[str, ...] = ()

    @property
    def evaluations(self) -> tuple[Variant, ...]:
        """The evaluations of the study; those of the runs themselves if it has none."""
        if self.study.evaluations:
            return self.study.evaluations
        return STAGES if self.study.command == "finetune" else (OWN,)

    @property
    def judged(self) -> tuple[Variant, ...]:
        """The evaluations that answer the question: those that the study names and agents have.

        If it names none, it is CART if agents have it, else the last that some have.
        """
        if named := [each for each in self.evaluations if each.name in self.study.judged]:
            return tuple(each for each in named if self._has(each)) or (named[0],)
        ranked = sorted(self.evaluations, key=lambda each: each.name == CART)
        return (next((each for each in reversed(ranked) if self._has(each)), ranked[-1]),)

    @property
    def finding(self) -> Finding | None:
        """What a person found in these very results; None if they are incomplete or others."""
        found = self._finding_of_size
        return found if found and not self.changed and found.digest == self.digest else None

    @property
    def lost_finding(self) -> Finding | None:
        """What a person found in other complete results of this size; None if there is no such finding."""
        return None if self.finding else self._finding_of_size

    @property
    def _finding_of_size(self) -> Finding | None:
        found = self.study.finding
        fits = found and found.size == self.label and not self.missing() and not self.exclusions
        return found if fits else None

    @property
    def digest(self) -> str:
        """A short hash of the measures of all agents; a finding is bound to it.

        It is the same for the runs and for their JSON file.
        """
        values = sorted(
            f"{agent.arm} {agent.seed} {evaluation} {_rounded(value)}"
            for agent in self.agents
            for evaluation, value in agent.values.items()
        )
        return hashlib.sha256("\n".join(values).encode()).hexdigest()[:DIGEST]

    @property
    def file(self) -> str:
        """The file of the study."""
        return f"conf/study/{self.name}.yaml" if self.shipped else f"{self.folder or self.name}/study.yaml"

    @property
    def remarks(self) -> list[str]:
        """Sentences about what today's file of the study says otherwise, and a finding of other results."""
        sentences, found = [], self.lost_finding
        if self.changed:
            sentences.append(f"{self.file} has changed since these runs: {', '.join(self.changed)}.")
        if found and found.digest == self.digest:
            sentences.append("Its finding is not shown.")
        elif found:
            other = f"(digest {found.digest or 'missing'}; these have {self.digest})"
            sentences.append(f"The finding in {self.file} is about other results {other}.")
        return sentences

    @property
    def varied(self) -> tuple[Variant, ...]:
        """The evaluations or, if they have none, the arms with values on the axis; empty without an axis."""
        if self.study.axis is None:
            return ()
        placed = (
            tuple(each for each in kind if each.value is not None)
            for kind in (self.evaluations, self.study.arms)
        )
        return next((each for each in placed if len(each) > 1), ())

    @property
    def size(self) -> Size | None:
        """The size of these results."""
        name = self.study.size or (next(iter(self.study.sizes)) if len(self.study.sizes) == 1 else "")
        return self.study.sizes.get(name)

    @property
    def label(self) -> str:
        """The name of the size, as on the command line."""
        return next((name for name, size in self.study.sizes.items() if size is self.size), "")

    def values(self, arm: str, evaluation: str) -> Array:
        """Return the measure of each agent of an arm [agents]."""
        return np.array(
            [
                agent.values[evaluation]
                for agent in self.agents
                if agent.arm == arm and evaluation in agent.values
            ]
        )

    def identity(self, agent: Agent) -> str:
        """Return the name that an agent has in all studies which evaluate it, as "swingup/thesis/10"."""
        arm = next(each for each in self.study.arms if each.name == agent.arm)
        named = self.study.shared_agent(arm) or f"{self.name}/{arm.name}/{SEED}"
        name = named.removeprefix(RUNS).replace(SEED, str(agent.seed))
        return name if SEED in named else f"{name} {agent.seed}"  # each seed of the baseline is one

    def _has(self, evaluation: Variant) -> bool:
        return any(evaluation.name in agent.values for agent in self.agents)

    def ratios(self, arm: str) -> Array:
        """Return (second evaluation) / (first evaluation) of each agent [agents].

        Agents whose first value is under SMALLEST of the study's highest are left out: the ratio of two
        failures means nothing.
        """
        names = self.evaluations[0].name, self.evaluations[1].name
        every, (first, second) = self.pairs(*names)[0], self.pairs(*names, arm)
        counts = (first > 0) & (first >= SMALLEST * max(every, default=0.0))
        return second[counts] / first[counts]

    def pairs(self, evaluation: str, other: str, arm: str | None = None) -> Array:
        """Return the measures of the agents (of `arm`) that have both evaluations [2, agents]."""
        both = [
            agent.values
            for agent in self.agents
            if {evaluation, other} <= agent.values.keys() and arm in (None, agent.arm)
        ]
        return np.array([[each[name] for each in both] for name in (evaluation, other)])

    def estimate(self, arm: str, evaluation: str) -> Estimate | None:
        """Return the interquartile mean of an arm; None without agents."""
        values = self.values(arm, evaluation)
        return estimate(values) if values.size else None

    def missing(self) -> list[str]:
        """Return a sentence for each arm and evaluation with fewer agents than the study asks for."""
        size = self.size
        return [
            f"{arm.label}, {evaluation.label}: {len(seeds)} of {size.seeds} seeds{_lacking(seeds, size)}"
            for arm in self.study.arms
            for evaluation in self.evaluations
            if size and len(seeds := self._seeds(arm.name, evaluation.name)) < size.seeds
        ]

    def _seeds(self, arm: str, evaluation: str) -> set[int]:
        """Return the seeds of an arm that have an evaluation."""
        return {agent.seed for agent in self.agents if agent.arm == arm and evaluation in agent.values}

    def as_json(self) -> dict[str, Any]:
        """Return the results as plain data for `from_json`."""
        agents = [
            {
                "arm": agent.arm,
                "seed": agent.seed,
                "run": agent.run,
                "values": {name: _rounded(value) for name, value in agent.values.items()},
                "curves": {
                    name: [[_rounded(x), _rounded(y)] for x, y in curve]
                    for name, curve in agent.curves.items()
                },
            }
            for agent in self.agents
        ]
        return {
            "format": FORMAT,
            "name": self.name,
            "study": self.study.model_dump(mode="json"),
            "agents": agents,
            "exclusions": [{"run": each.run, "reason": each.reason} for each in self.exclusions],
            "notes": list(self.notes),
            "versions": self.versions,
            "folder": self.folder,
        }


def from_json(content: Mapping[str, Any], study: Study) -> StudyResults:
    """Return the results of `study` in a JSON file. Raises KeyError, TypeError or ValueError."""
    if content["format"] != FORMAT:
        raise ValueError(f"format {content['format']}; this version reads format {FORMAT}")
    results = StudyResults(
        checked_name(content["name"]),
        study,
        tuple(map(_agent, content["agents"])),
        tuple(Exclusion(str(each["run"]), str(each["reason"])) for each in content["exclusions"]),
        tuple(map(str, content["notes"])),
        str(content["versions"]),
        str(content["folder"]),
    )
    _check_agents(results)
    return results


def checked_name(name: str) -> str:
    """Return the name of a study, which names files and parts of the page. Raises ValueError."""
    try:
        return NAME.validate_python(name)
    except ValueError:
        raise ValueError(f"{name!r} is no name of a study; give letters, digits and . _ + - alone") from None


def _agent(content: Mapping[str, Any]) -> Agent:
    """Return an agent of a JSON file. Raises KeyError, TypeError or ValueError."""
    return Agent(
        content["arm"],
        int(content["seed"]),
        str(content["run"]),
        {name: _number(value) for name, value in content["values"].items()},
        {
            name: tuple((_number(x), _number(y)) for x, y in curve)
            for name, curve in content["curves"].items()
        },
    )


def _check_agents(results: StudyResults) -> None:
    """Raise ValueError for an agent that is there twice, or of an arm or evaluation that the study lacks."""
    arms, evaluations = ({each.name for each in kind} for kind in (results.study.arms, results.evaluations))
    seen = set()
    for agent in results.agents:
        if agent.arm not in arms or not evaluations >= agent.values.keys():
            raise ValueError(
                f"agent {agent.arm}/{agent.seed} is of an arm or evaluation that the study lacks"
            )
        if (agent.arm, agent.seed) in seen:
            raise ValueError(f"agent {agent.arm}/{agent.seed} is there twice")
        seen.add((agent.arm, agent.seed))


def _lacking(seeds: Collection[int], size: Size) -> str:
    """Return the seeds that are not there as ", 12 and 15 are missing"; empty if none or many of them are."""
    lacking = [str(seed) for seed in size.every_seed if seed not in seeds]
    if not seeds or not lacking or len(lacking) > MOST_LACKING:
        return ""
    *others, last = lacking
    return f", {', '.join(others)} and {last} are missing" if others else f", {last} is missing"


def _number(value: Any) -> float:
    """Return a number that can be shown. Raises ValueError."""
    if not is_number(value):
        raise ValueError(f"{str(value)[:20]} is no number")
    return float(value)


def is_number(value: Any) -> bool:
    """Return True for a finite number that figures can show; a boolean is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _rounded(value: float) -> float:
    """Return `value` with DIGITS significant digits, an integer where it is one."""
    if value == 0:
        return 0  # no minus zero
    if not math.isfinite(value):
        return value
    rounded = round(value, DIGITS - 1 - math.floor(math.log10(abs(value))))
    return int(rounded) if rounded == int(rounded) else rounded
