"""The results of a study as plain numbers, how they stand, and their small JSON file."""

import hashlib
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from study import RUNS, SEED, Finding, FolderName, Size, Study, Variant

from cartpole_rl.checking import validated
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.results import GOOD, OWN, Agent, Exclusion, Group, Named, Results, is_number
from cartpole_rl.reporting.runs import DAMAGE, short
from cartpole_rl.reporting.statistics import Array, Estimate, estimate
from cartpole_rl.run_folder import write_json

FORMAT = 1  # of the JSON file
DIGITS = 6  # significant, of the numbers in it
DIGEST = 8  # hex digits
STAGES = (Group("before", "before"), Group("after", "after fine-tuning"))
PICTURED = ("identify", "model")  # commands whose results are figures
CART = "emulated"  # evaluation on the cart that stands for the real one
NAME: TypeAdapter[str] = TypeAdapter(FolderName)
MOST_LACKING = 5  # seeds that are named one by one
SMALLEST = 0.1  # share of the study's highest value, below which an agent has no ratio


class Status(StrEnum):
    """How a study stands, in the order of the summary."""

    FAILS = "fails"
    CONTRADICTS = "contradicts the thesis"
    DIFFERS = "differs from the thesis"
    EMPTY = "no result"
    INCOMPLETE = "incomplete"
    OPEN = "not judged"
    NOT_SHOWN = "not shown"
    NEW = "new"
    AGREES = "agrees"


@dataclass(frozen=True)
class StudyResults(Results):
    """The agents of a study that count, the runs that do not, and remarks on how they were made.

    A `shipped` study is one of studies/; `changed` names what today's file there has made otherwise.
    """

    study: Study = field(kw_only=True)
    folder: str = ""  # relative path of the runs
    shipped: bool = False
    changed: tuple[str, ...] = ()

    @classmethod
    def of(cls, name: str, study: Study, agents: Sequence[Agent] = (), **more: Any) -> "StudyResults":
        """Return the results of `study` under its `name`; `more` are further fields."""
        own = STAGES if study.command == "finetune" else (OWN,)
        return cls(
            name,
            study.title,
            study.measure,
            study.arms,
            tuple(agents),
            evaluations=study.evaluations or own,
            unit=study.unit,
            pictured=study.command in PICTURED,
            study=study,
            **more,
        )

    def with_study(self, study: Study, changed: Sequence[str]) -> "StudyResults":
        """Return these results with the texts of a study of studies/, which has `changed` since."""
        kept = {name: getattr(self, name) for name in ("exclusions", "notes", "versions", "folder")}
        return StudyResults.of(self.name, study, self.agents, shipped=True, changed=tuple(changed), **kept)

    @property
    def judged(self) -> Sequence[Named]:
        """The evaluations that answer the question: those that the study names and agents have.

        If it names none, it is CART if agents have it, else the last that some have.
        """
        if named := [each for each in self.evaluations if each.name in self.study.judged]:
            return [each for each in named if self._has(each)] or named[:1]
        ranked = sorted(self.evaluations, key=lambda each: each.name == CART)
        return [next((each for each in reversed(ranked) if self._has(each)), ranked[-1])]

    def _has(self, evaluation: Named) -> bool:
        return any(evaluation.name in agent.values for agent in self.agents)

    @property
    def varied(self) -> tuple[Variant, ...]:
        """The evaluations or, if they have none, the arms with values on the axis; empty without an axis."""
        if self.study.axis is None:
            return ()
        kinds = (self.study.evaluations, self.study.arms)
        placed = (tuple(each for each in kind if each.value is not None) for kind in kinds)
        return next((each for each in placed if len(each) > 1), ())

    @property
    def size(self) -> Size | None:
        """The size of these results."""
        return self.study.sizes.get(self.label)

    @property
    def label(self) -> str:
        """The name of the size, as on the command line."""
        only = [*self.study.sizes] if len(self.study.sizes) == 1 else [""]
        return self.study.size or only[0]

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
            f"{agent.group} {agent.seed} {evaluation} {_rounded(value)}"
            for agent in self.agents
            for evaluation, value in agent.values.items()
        )
        return hashlib.sha256("\n".join(values).encode()).hexdigest()[:DIGEST]

    @property
    def remarks(self) -> list[str]:
        """Sentences about what today's file of the study says otherwise, and a finding of other results."""
        runs = self.folder or self.name
        file = f"scripts/thesis/studies/{self.name}.yaml" if self.shipped else f"{runs}/study.yaml"
        sentences, found = [], self.lost_finding
        if self.changed:
            sentences.append(f"{file} has changed since these runs: {', '.join(self.changed)}.")
        if found and found.digest == self.digest:
            sentences.append("Its finding is not shown.")
        elif found:
            other = f"(digest {found.digest or 'missing'}; these have {self.digest})"
            sentences.append(f"The finding in {file} is about other results {other}.")
        return sentences

    def status(self) -> Status:
        """Return how the study stands: by the verdict that a person wrote about these results, else by them.

        Without a verdict a study fails if, in an evaluation that counts, every interquartile mean is low.
        """
        if not self.agents:
            return Status.EMPTY
        if self.finding:
            return Status[self.finding.verdict.upper().replace(" ", "_")]
        if self._all_low():
            return Status.FAILS
        return Status.INCOMPLETE if self.missing() or self.exclusions else Status.OPEN

    def reason(self) -> str:
        """Return why a study fails where no person wrote it: ": no interquartile mean reaches 2000"."""
        if self.finding or not (failed := self._all_low()):
            return ""
        place = f" ({', '.join(each.label for each in failed)})" if len(self.evaluations) > 1 else ""
        return f": no interquartile mean reaches {GOOD[self.measure]:g}{place}"

    def _all_low(self) -> list[Named]:
        """Return the evaluations that count in which every arm is below GOOD; one of an axis may be hard."""
        good = GOOD.get(self.measure)
        if good is None or self.varied:
            return []
        means = ((each, [one.value for one in self.estimates(each.name).values()]) for each in self.judged)
        return [each for each, values in means if max(values, default=good) < good]

    def identity(self, agent: Agent) -> str:
        """Return the name that an agent has in all studies which evaluate it, as "swingup/thesis/10"."""
        arm = next(each for each in self.study.arms if each.name == agent.group)
        named = self.study.shared_agent(arm) or f"{self.name}/{arm.name}/{SEED}"
        name = named.removeprefix(RUNS).replace(SEED, str(agent.seed))
        return name if SEED in named else f"{name} {agent.seed}"  # each seed of the baseline is one

    def pairs(self, evaluation: str, other: str, arm: str | None = None) -> Array:
        """Return the measures of the agents (of `arm`) that have both evaluations [2, agents]."""
        agents = self.agents if arm is None else self.members(arm)
        both = [agent.values for agent in agents if {evaluation, other} <= agent.values.keys()]
        return np.array([[each[name] for each in both] for name in (evaluation, other)])

    def ratios(self, arm: str) -> Array:
        """Return (second evaluation) / (first evaluation) of each agent [agents].

        Agents whose first value is under SMALLEST of the study's highest are left out: the ratio of two
        failures means nothing.
        """
        names = self.evaluations[0].name, self.evaluations[1].name
        every, (first, second) = self.pairs(*names)[0], self.pairs(*names, arm)
        counts = (first > 0) & (first >= SMALLEST * max(every, default=0.0))
        return second[counts] / first[counts]

    def mean_ratios(self) -> dict[str, Estimate]:
        """Return the interquartile mean of each arm's ratio (by label); empty if the study asks for none."""
        found = {arm.label: self.ratios(arm.name) for arm in self.study.arms if self.study.ratio}
        return {label: estimate(values) for label, values in found.items() if values.size}

    def missing(self) -> list[str]:
        """Return a sentence for each arm and evaluation with fewer agents than the study asks for."""
        size = self.size
        return [
            f"{arm.label}, {evaluation.label}: {len(seeds)} of {size.seeds} seeds{_lacking(seeds, size)}"
            for arm in self.groups
            for evaluation in self.evaluations
            if size
            and len(seeds := {each.seed for each in self.members(arm.name) if evaluation.name in each.values})
            < size.seeds
        ]


def _lacking(seeds: Collection[int], size: Size) -> str:
    """Return the seeds that are not there as ", 12 and 15 are missing"; empty if none or many of them are."""
    lacking = [str(seed) for seed in size.every_seed if seed not in seeds]
    if not seeds or not lacking or len(lacking) > MOST_LACKING:
        return ""
    *others, last = lacking
    return f", {', '.join(others)} and {last} are missing" if others else f", {last} is missing"


def checked_name(name: str) -> str:
    """Return the name of a study, which names files and parts of the page. Raises ValueError."""
    try:
        return NAME.validate_python(name)
    except ValueError:
        raise ValueError(f"{name!r} is no name of a study; give letters, digits and . _ + - alone") from None


def write_data(results: Sequence[StudyResults], folder: Path) -> None:
    """Write a JSON file for each study that has agents."""
    for each in results:
        if each.agents:
            write_json(folder / f"{each.name}.json", as_json(each))


def as_json(results: StudyResults) -> dict[str, Any]:
    """Return results as plain data for `from_json`."""
    agents = [
        {
            "arm": agent.group,
            "seed": agent.seed,
            "run": agent.run,
            "values": {name: _rounded(value) for name, value in agent.values.items()},
            "curves": {
                name: [[_rounded(x), _rounded(y)] for x, y in curve] for name, curve in agent.curves.items()
            },
            "behaviour": {
                name: {key: _rounded(value) for key, value in each.items()}
                for name, each in agent.behaviour.items()
            },
        }
        for agent in results.agents
    ]
    return {
        "format": FORMAT,
        "name": results.name,
        "study": results.study.model_dump(mode="json"),
        "agents": agents,
        "exclusions": [{"run": each.run, "reason": each.reason} for each in results.exclusions],
        "notes": list(results.notes),
        "versions": results.versions,
        "folder": results.folder,
    }


def read_json(file: Path) -> StudyResults:
    """Return the results in a file of `write_data`. Raises ConfigError if it is damaged."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        results = from_json(content, validated(Study, content["study"]))
    except json.JSONDecodeError as error:
        raise ConfigError(f"{file} is damaged (line {error.lineno}): restore it or remove it") from None
    except DAMAGE as error:
        raise ConfigError(
            f"{file} is not a file of results: {short(error)}; restore it or remove it"
        ) from None
    if results.name != file.stem:
        raise ConfigError(
            f"{file}: it holds the study {results.name}; rename it to {results.name}.json, "
            "or remove it if it is a copy"
        )
    return results


def from_json(content: Mapping[str, Any], study: Study) -> StudyResults:
    """Return the results of `study` in a JSON file. Raises KeyError, TypeError or ValueError."""
    if content["format"] != FORMAT:
        raise ValueError(f"format {content['format']}; this version reads format {FORMAT}")
    results = StudyResults.of(
        checked_name(content["name"]),
        study,
        [*map(_agent, content["agents"])],
        exclusions=tuple(Exclusion(str(each["run"]), str(each["reason"])) for each in content["exclusions"]),
        notes=tuple(map(str, content["notes"])),
        versions=str(content["versions"]),
        folder=str(content["folder"]),
    )
    arms, evaluations = ({each.name for each in kind} for kind in (study.arms, results.evaluations))
    seen = set()
    for agent in results.agents:
        place = agent.group, agent.seed
        if agent.group not in arms or not evaluations >= agent.values.keys():
            raise ValueError(
                f"agent {agent.group}/{agent.seed} is of an arm or evaluation that the study lacks"
            )
        if place in seen:
            raise ValueError(f"agent {agent.group}/{agent.seed} is there twice")
        seen.add(place)
    return results


def _agent(content: Mapping[str, Any]) -> Agent:
    """Return an agent of a JSON file. Raises KeyError, TypeError or ValueError."""
    values = {name: _number(value) for name, value in content["values"].items()}
    curves = {
        name: tuple((_number(x), _number(y)) for x, y in curve) for name, curve in content["curves"].items()
    }
    behaviour = {  # earlier files have none
        name: {key: _number(value) for key, value in each.items()}
        for name, each in content.get("behaviour", {}).items()
    }
    return Agent(content["arm"], int(content["seed"]), str(content["run"]), values, curves, behaviour)


def _number(value: Any) -> float:
    """Return a number that can be shown. Raises ValueError."""
    if not is_number(value):
        raise ValueError(f"{str(value)[:20]} is no number")
    return float(value)


def _rounded(value: float) -> float:
    """Return `value` with DIGITS significant digits, an integer where it is one."""
    if value == 0:
        return 0  # no minus zero
    if not math.isfinite(value):
        return value
    rounded = round(value, DIGITS - 1 - math.floor(math.log10(abs(value))))
    return int(rounded) if rounded == int(rounded) else rounded
