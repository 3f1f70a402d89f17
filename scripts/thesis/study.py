"""The settings of a study: one row or figure of the thesis, or one beyond it (`studies/<name>.yaml`).

The copy of a study in its folder of results, study.yaml, also names its size. In overrides `{runs}` stands
for the folder of all studies and `{seed}` for the seed of the agent, as in
`run={runs}/todays_agents/medium/{seed}`. An arm of a training with `run=` trains no agent: that agent, or the
baseline of run=lqr, is evaluated, with the other overrides of the arm.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, StringConstraints, field_validator, model_validator

from cartpole_rl.checking import most_similar, similarity, validated
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Count, Finite, Settings

STUDIES = Path(__file__).with_name("studies")
NEAR = 0.5  # similarity of two names, from which one is suggested for the other
RUN = "run="  # the override that names an agent
RUNS, SEED = "{runs}/", "{seed}"
FIRST_SEED = 10  # settings were chosen on seeds 0 to 9

FolderName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$")]
Overrides = tuple[str, ...]


class Axis(Settings):
    """The quantity whose values the arms or the evaluations of a study take."""

    label: str
    unit: str = ""


class Variant(Settings):
    """An arm or an evaluation: a folder's name, its label on the page, and the overrides of the command."""

    name: FolderName
    label: str
    value: Finite | None = None  # on the axis of the study
    overrides: Overrides = ()


class Evaluation(Variant):
    """An evaluation of each agent of a study."""

    of_arms: Mapping[FolderName, Overrides] = {}  # more overrides for the agents of some arms

    def words(self, arm: str, common: Overrides) -> Overrides:
        """Return the overrides for the agents of `arm`, with those of `common` that they leave open."""
        own = (*self.overrides, *self.of_arms.get(arm, ()))
        chosen = {setting(word) for word in own}
        return (*own, *(word for word in common if setting(word) not in chosen))


class Finding(Settings):
    """What a person found in the complete results of one size. It is shown with these results alone."""

    size: str
    digest: str = ""  # of the results (`results.StudyResults.digest`); report.py prints the one to enter
    # the thesis's claims are judged by claims.py; "fails": it does not work
    verdict: Literal["fails", "contradicts", "differs", "not shown", "agrees", "new"]
    comment: str  # why the results agree with the thesis or contradict it

    @field_validator("verdict", mode="before")
    @classmethod
    def _of_earlier_files(cls, verdict: object) -> object:
        return "new" if verdict == "answered" else verdict


class Size(Settings):
    """The number of agents per arm, and overrides for all arms and all evaluations."""

    seeds: Count
    overrides: Overrides = ()
    evaluation_overrides: Overrides = ()

    @property
    def every_seed(self) -> range:
        """The seeds of the agents."""
        return range(FIRST_SEED, FIRST_SEED + self.seeds)


class Study(Settings):
    """A question, its arms and its evaluations. Every arm has one run of `command` per seed."""

    title: str
    order: int  # on the page: 10 times the row of the thesis's list; 200 and above lie beyond the thesis
    figure: str = ""  # figure, table or section of the thesis; empty beyond it
    question: str
    thesis: str = ""  # the thesis's answer
    finding: Finding | None = None
    measure: str = "score"  # score (6.2), score_upright (6.1) or another key of metrics.json
    ratio: bool = False  # also the second evaluation divided by the first, per agent
    axis: Axis | None = None
    curves: tuple[Literal["score", "loss"], ...] = ("score",)  # of trainings; score is that of `measure`
    arms: Annotated[tuple[Variant, ...], Field(min_length=1)]
    evaluations: tuple[Evaluation, ...] = ()  # by cartpole-evaluate; none if the run itself holds the result
    judged: tuple[FolderName, ...] = ()  # evaluations that answer the question; empty: that on the cart
    command: Literal["train", "identify", "evaluate", "finetune", "model"] = "train"
    experiment: str = ""  # file of conf/experiment/; empty for commands without experiments
    agents_of: str = ""  # name of the study whose agents are evaluated instead of new ones
    sizes: Annotated[dict[str, Size], Field(min_length=1)]
    size: str = ""  # of the results in the same folder, one of `sizes`; empty in studies/

    @property
    def place(self) -> str:
        """Place in the thesis: "Fig. 6.8" for 6.8, "Section 3.1.3" for other numbers, or text as it is."""
        if re.match(r"\d+\.\d+[a-z]?(,|$)", self.figure):
            return f"Fig. {self.figure}"
        return f"Section {self.figure}" if self.figure[:1].isdigit() else self.figure

    @property
    def unit(self) -> str:
        """What a run of the command makes."""
        return {"identify": "identification", "model": "model"}.get(self.command, "agent")

    def agent_of(self, arm: Variant) -> str | None:
        """Return the agent that an arm names by run= instead of training one; None if the arm has a run."""
        named = [word.removeprefix(RUN) for word in arm.overrides if word.startswith(RUN)]
        return named[-1] if named and self.command == "train" else None

    def shared_agent(self, arm: Variant) -> str | None:
        """Return the agent that an arm evaluates instead of having a run, with its placeholders, or None."""
        if named := self.agent_of(arm):
            return named
        return f"{RUNS}{self.agents_of}/{arm.name}/{SEED}" if self.agents_of else None

    def evaluated_with(self, arm: Variant) -> Overrides:
        """Return the overrides for all evaluations of an arm that names its agent by run=."""
        words = arm.overrides if self.agent_of(arm) else ()
        return tuple(word for word in words if not word.startswith(RUN))

    def trains(self, arm: Variant) -> bool:
        """Return True if each seed of an arm has a training in its own folder."""
        return self.command in ("train", "finetune") and self.shared_agent(arm) is None

    @model_validator(mode="after")
    def _is_consistent(self) -> "Study":
        for kind, variants in (("arms", self.arms), ("evaluations", self.evaluations)):
            for names in ([each.name for each in variants], [each.label for each in variants]):
                if repeated := sorted({name for name in names if names.count(name) > 1}):
                    raise ValueError(
                        f"{kind}: {', '.join(repeated)} is there more than once; give unique names and labels"
                    )
        for name, size in (("size", self.size), ("finding.size", self.finding.size if self.finding else "")):
            if size and size not in self.sizes:
                raise ValueError(f"{name}: {size} is not in sizes; give one of {', '.join(self.sizes)}")
        evaluations, arms = [each.name for each in self.evaluations], [each.name for each in self.arms]
        of_arms = [name for each in self.evaluations for name in each.of_arms]
        for kind, names, known in (("judged", [*self.judged], evaluations), ("of_arms", of_arms, arms)):
            if unknown := [name for name in names if name not in known]:
                raise ValueError(f"{kind}: {unknown[0]} is unknown; give some of {', '.join(known)}")
        if self.ratio and len(self.evaluations) < 2:
            raise ValueError("ratio=true needs two evaluations: the second is divided by the first")
        return self


def study_names(source: Path = STUDIES) -> list[str]:
    """Return the names of all studies in `source`, in the order of the page. Raises ConfigError."""
    names = [path.stem for path in source.glob("*.yaml")]
    if not names:
        raise ConfigError(f"{source}: it holds no study")
    return sorted(names, key=lambda name: (load_study(name, source).order, name))


def load_study(name: str, source: Path = STUDIES) -> Study:
    """Return a study of `source`. ConfigError names the nearest study or the mistake."""
    if not source.is_dir():
        raise ConfigError(f"{source}: there is no such folder of studies")
    if not (source / f"{name}.yaml").is_file():
        raise ConfigError(unknown("study", name, (other.stem for other in source.glob("*.yaml"))))
    return read_study_file(source / f"{name}.yaml")


def read_study_file(file: Path) -> Study:
    """Return the study in a YAML file. Raises ConfigError."""
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
        if not isinstance(values, Mapping):
            raise ConfigError("it holds no study")
        return validated(Study, values)
    except (ConfigError, OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from None


def unknown(kind: str, name: str, names: Iterable[str]) -> str:
    """Return the message for a name that is none of `names`."""
    known = [*names]
    near = most_similar(name, known) if known else ""
    hint = f"did you mean {near}?" if near and similarity(name, near)[0] > NEAR else "--list names them"
    return f"{name}: there is no such {kind}; {hint}"


def setting(word: str) -> str:
    """Return the name of the setting that an override changes."""
    return word.lstrip("+").partition("=")[0]


def overrides_of(words: Sequence[str], root: Path | None = None) -> dict[str, Any]:
    """Return overrides as on a command line by name, their values as YAML reads them; the last one counts.

    Paths below `root` are taken as they are: a folder's name may hold what means something else in YAML.
    """
    below = "(?!)" if root is None else rf"(?<![^\[,\s]){re.escape(f'{root}/')}[^,\]]*[^,\]\s]"

    def quoted(value: str) -> str:
        return re.sub(below, lambda path: json.dumps(path[0], ensure_ascii=False), value)

    return {setting(word): yaml.safe_load(quoted(word.partition("=")[2])) for word in words}
