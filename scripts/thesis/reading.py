"""Reads the results of studies, from run folders or from small JSON files.

A folder of studies has a folder for each: study.yaml, and <arm>/<seed>/ with the run and its
evaluations/<evaluation>/. Runs that are unfinished, damaged, of other versions or settings than the rest, or
of another seed or agent than their place says, are named and do not count.
"""

from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

from results import STAGES, StudyResults, checked_name, read_json
from study import RUN, RUNS, SEED, STUDIES, Evaluation, Study, Variant, read_study_file, setting

from cartpole_rl.choices import conf_folder
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.results import EVALUATIONS, OWN, Agent, Curve, Exclusion
from cartpole_rl.reporting.runs import (
    FREE,
    Run,
    commits_note,
    learning_curve,
    measured,
    partly_measured_note,
    read_run,
    run_of,
    short,
)
from cartpole_rl.reporting.tensorboard import scalars
from cartpole_rl.run_folder import CONFIG, PREFIX

Item = TypeVar("Item")
STUDY = "study.yaml"
EMULATOR = "emulator="
TEXTS = ("title", "order", "figure", "question", "thesis", "finding", "judged")  # of today's study
MADE = ("measure", "command", "experiment", "ratio", "agents_of")  # what the results depend on
DERIVED = {"evaluated", "guard"}  # settings that follow from others
ITSELF = ""  # evaluation of a part that is the run of an arm and a seed itself
CURVE_POINTS = 60
# keys of metrics.json and identification.json that are stored with the scores
BEHAVIOUR = (
    *("upright_at_end", "time_to_upright_s", "rms_angle_rad", "rms_position_m"),
    *("rms_motor_change", "motor_reversals_per_s"),
    *("falls", "recovered_fraction", "recovery_s", "recovery_swings"),
    *("parameters.pole_coulomb", "parameters.pole_drag"),
)


@dataclass(frozen=True)
class Part:
    """A run of a study: that of an arm and a seed, or one of its evaluations (`evaluation`)."""

    arm: str
    seed: int
    evaluation: str
    run: Run

    @property
    def place(self) -> tuple[str, int]:
        """The arm and the seed."""
        return self.arm, self.seed

    def excluded(self, reason: str) -> Exclusion:
        """Return the run as one that does not count."""
        return Exclusion(self.run.folder.as_posix(), reason)


def read_studies(folder: Path) -> list[StudyResults]:
    """Return the results of the studies in `folder` in the order of the page.

    `folder` holds folders of studies or JSON files of `write_data`, or is the folder of one study. If one of
    several is of studies/, the others of studies/ are added without results. Raises ConfigError.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such folder")
    if (folder / STUDY).is_file():
        return [read_study(folder)]
    places = sorted(path.parent for path in folder.glob(f"*/{STUDY}"))
    found = [read_study(place) for place in places]
    found = found or [_with_texts(read_json(file)) for file in sorted(folder.glob("*.json"))]
    if not found:
        raise ConfigError(f"{folder}: it holds no study; give a folder that scripts/reproduce wrote")
    names = {each.name for each in found}
    others = [file for file in sorted(STUDIES.glob("*.yaml")) if file.stem not in names]
    if any(each.shipped for each in found):
        found += [StudyResults.of(file.stem, read_study_file(file), shipped=True) for file in others]
    return sorted(found, key=lambda each: (each.study.order, each.name))


def emulators(results: Sequence[StudyResults]) -> dict[str, str]:
    """Return the files of conf/emulator/ that the studies choose by emulator=<name>, by that name."""
    variants = [each for one in results for each in (*one.study.arms, *one.study.evaluations)]
    words = {word for variant in variants for word in variant.overrides if word.startswith(EMULATOR)}
    names = sorted(word.removeprefix(EMULATOR) for word in words)
    files = {name: conf_folder() / "emulator" / f"{name}.yaml" for name in names}
    return {name: file.read_text(encoding="utf-8") for name, file in files.items() if file.is_file()}


def _with_texts(results: StudyResults) -> StudyResults:
    """Return the results with the texts of today's study, which are written after the runs.

    A user's own study that has the name of a shipped one keeps its own.
    """
    file = STUDIES / f"{results.name}.yaml"
    if not file.is_file():
        return results
    today, then = read_study_file(file), results.study
    if not (changed := _changes(then, today, results.label)):
        return results.with_study(today.model_copy(update={"size": results.label}), ())
    if then.question == today.question or then.title == today.title:
        texts = {name: getattr(today, name) for name in TEXTS}
        return results.with_study(then.model_copy(update=texts), changed)
    return results


def _changes(then: Study, today: Study, size: str) -> list[str]:
    """Return the settings in which today's study differs; labels are ignored."""

    def unlabelled(variants: Sequence[Variant]) -> list[dict[str, Any]]:
        return [each.model_dump(exclude={"label"}) for each in sorted(variants, key=lambda each: each.name)]

    changed = [name for name in MADE if getattr(then, name) != getattr(today, name)]
    changed += ["axis"] if (then.axis and then.axis.unit) != (today.axis and today.axis.unit) else []
    for name in ("arms", "evaluations"):
        changed += [name] if unlabelled(getattr(then, name)) != unlabelled(getattr(today, name)) else []
    return changed + ([f"size {size}"] if size and then.sizes.get(size) != today.sizes.get(size) else [])


def read_study(folder: Path) -> StudyResults:
    """Return the results in the folder of one study. Raises ConfigError."""
    try:
        name = checked_name(folder.absolute().name)
    except ValueError as error:
        raise ConfigError(f"{folder}: {error}") from None
    study = read_study_file(folder / STUDY)
    if not study.size and folder.parent.name in study.sizes:
        study = study.model_copy(update={"size": folder.parent.name})
    return _with_texts(_Reader(folder, name, study).results())


class _Reader:
    """Reads the folder of one study, and collects what does not count."""

    def __init__(self, folder: Path, name: str, study: Study) -> None:
        self.folder, self.name, self.study = folder, name, study
        self.exclusions = [*self._misnamed(), *self._foreign()]
        self.notes: list[str] = []

    def results(self) -> StudyResults:
        """Return the results."""
        parts = self._of_one_kind(self._complete([*self._parts()]))
        agents, curveless = self._agents(parts), self.notes
        counted = [part.run for part in parts if part.evaluation != ITSELF or not self.study.evaluations]
        notes = (
            *self._unlisted(),
            *self._untraced(),
            *(
                f"{arm.label}: each agent has its own {', '.join(sorted(own))}, from a run of its seed."
                for arm in self.study.arms
                if (own := _own_groups(parts, arm.name))
            ),
            *self._unexplained(parts),
            commits_note(part.run for part in parts),
            partly_measured_note(counted, self.study.measure),
            *curveless,
        )
        return StudyResults.of(
            self.name,
            self.study,
            agents,
            exclusions=tuple(self.exclusions),
            notes=tuple(filter(None, notes)),
            versions=parts[0].run.versions if parts else "",
            folder=self.folder.as_posix(),
        )

    def _parts(self) -> Iterator[Part]:
        """Yield every run of the study that has a folder."""
        for arm in self.study.arms:
            for place in self._places(arm):
                seed = int(place.name)
                own = next((each for each in (place, self._origin(arm, seed)) if _is_run(each)), place)
                if _is_run(own) or not self.study.evaluations or self.study.trains(arm):
                    named = int(own.name) if own.name.isdecimal() else None
                    yield Part(arm.name, seed, ITSELF, _fitting(read_run(own), named, ""))
                for evaluation in self.study.evaluations:
                    inner = place / EVALUATIONS / evaluation.name
                    if inner.is_dir() or inner.is_symlink():
                        run = _fitting(read_run(inner), seed, self._agent_of(arm, evaluation, seed))
                        yield Part(arm.name, seed, evaluation.name, run)

    def _agent_of(self, arm: Variant, evaluation: Evaluation, seed: int) -> str:
        """Return the agent that an evaluation must name, below RUNS if a study made it; empty for any."""
        words = [word for word in evaluation.words(arm.name, ()) if word.startswith(RUN)]
        named = words[-1].removeprefix(RUN) if words else self.study.shared_agent(arm)
        if named is None and self.study.command in ("train", "finetune"):
            named = f"{RUNS}{self.name}/{arm.name}/{SEED}"
        return (named or "").replace(SEED, str(seed))

    def _origin(self, arm: Variant, seed: int) -> Path:
        """Return the run of another study whose agent an arm evaluates; the arm's own where it trains one."""
        if (named := self.study.shared_agent(arm)) is None:
            return self.folder / arm.name / str(seed)
        return run_of(Path(named.replace(RUNS, f"{self.folder.parent.as_posix()}/").replace(SEED, str(seed))))

    def _places(self, arm: Variant) -> list[Path]:
        """Return the folders of an arm that belong to the size of the study."""
        size = self.study.sizes.get(self.study.size)
        found = _seeds(self.folder / arm.name)
        return [place for place in found if size is None or int(place.name) in size.every_seed]

    def _misnamed(self) -> Iterator[Exclusion]:
        """Yield the folders of arms whose names look like a seed and are none."""
        for place in (
            place for arm in self.study.arms for place in sorted(self.folder.glob(f"{arm.name}/*"))
        ):
            if place.name.isnumeric() and not _is_seed(place.name):
                yield Exclusion(place.as_posix(), "its name is no seed")

    def _foreign(self) -> Iterator[Exclusion]:
        """Yield the folders of arms with other seeds than the size of the study has."""
        for arm in self.study.arms:
            for place in sorted({*_seeds(self.folder / arm.name)} - {*self._places(arm)}, key=_seed):
                every = self.study.sizes[self.study.size].every_seed
                asked = f"{every[0]} to {every[-1]}" if len(every) > 1 else str(every[0])
                reason = f"its seed is none of size {self.study.size}, which has {asked}"
                yield Exclusion(place.as_posix(), reason)

    def _complete(self, parts: Sequence[Part]) -> list[Part]:
        """Return the parts without problem; an agent whose own run has one is left out whole."""
        broken = {part.place for part in parts if part.evaluation == ITSELF and part.run.problem}
        self.exclusions += [part.excluded(part.run.problem) for part in parts if part.run.problem]
        return [part for part in parts if not part.run.problem and part.place not in broken]

    def _of_one_kind(self, parts: Sequence[Part]) -> list[Part]:
        """Return the parts of the most frequent versions and, within an arm, settings."""
        parts, others = split_by_majority(parts, lambda part: part.run.versions)
        self.exclusions += [
            part.excluded(f"other versions: {part.run.versions or 'unknown'} instead of {common}")
            for part, common in others
        ]
        left_out, kept = [part for part, _ in others], []
        own = {arm: _own_groups(parts, arm) for arm in {part.arm for part in parts}}
        for (arm, _), group in groupby(sorted(parts, key=_kind), key=_kind):
            ignored = own[arm] | {f"evaluated.{name}" for name in own[arm]}
            key = partial(_settings, ignored)
            same, different = split_by_majority([*group], key)
            kept += same
            for part, _ in different:
                difference = settings_difference(part.run, same[0].run, ignored)
                self.exclusions.append(part.excluded(f"other settings: {difference}"))
                left_out.append(part)
        # an agent whose own run is odd is left out whole
        odd = {part.place for part in left_out if part.evaluation == ITSELF}
        return [part for part in kept if part.place not in odd]

    def _agents(self, parts: Sequence[Part]) -> list[Agent]:
        """Return the agents with a measure."""
        agents, arms = [], {arm.name: arm for arm in self.study.arms}
        for (arm, seed), group in groupby(
            sorted(parts, key=lambda part: part.place), lambda part: part.place
        ):
            found = {part.evaluation: part for part in group}
            values = self._values({name: part.run for name, part in found.items()})
            for name, value in values.items():
                if value is None:
                    part = found.get(name) or found[ITSELF]
                    self.exclusions.append(part.excluded(f"it has no {self.study.measure}"))
            present = {name: value for name, value in values.items() if value is not None}
            if present:
                path = (self.folder / arm / str(seed)).as_posix()
                own = found[ITSELF].run if ITSELF in found else None
                curves = self._curves(own, self._origin(arms[arm], seed))
                known = {OWN.name: found[ITSELF]} | found if ITSELF in found else found
                behaviour = {name: _behaviour(known[name].run) for name in present if name in known}
                agents.append(Agent(arm, seed, path, present, curves, behaviour))
        order = [*arms]
        return sorted(agents, key=lambda agent: (order.index(agent.group), agent.seed))

    def _values(self, runs: Mapping[str, Run]) -> dict[str, float | None]:
        """Return the measure of each evaluation of an agent that was run."""
        study = self.study
        if study.evaluations:
            names = [each.name for each in study.evaluations if each.name in runs]
            return {name: measured(runs[name].results, study.measure) for name in names}
        own = runs[ITSELF].results
        if study.command == "finetune":
            stages: Any = own.get("comparison", {})
            return {each.name: measured(stages.get(each.name, {}), study.measure) for each in STAGES}
        return {OWN.name: measured(own, study.measure)}

    def _curves(self, run: Run | None, origin: Path) -> dict[str, Curve]:
        """Return the curves of a training that the study shows; TensorBoard's are in its `origin`."""
        if run is None or run.program != "train":
            return {}
        curves: dict[str, Sequence[tuple[float, float]]] = {}
        try:
            if "score" in self.study.curves:
                name, curve = learning_curve(run.folder, self.study.measure)
                curves[name] = curve
            if "loss" in self.study.curves:
                curves["loss"] = scalars(origin, "learning/loss")
        except Exception as error:  # whatever the reader of a damaged file raises
            self.notes.append(f"The curves of {run.folder.as_posix()} are not drawn: {short(error)}.")
            return {}
        return {name: _thinned(curve) for name, curve in curves.items() if len(curve) > 1}

    def _unlisted(self) -> Iterator[str]:
        """Yield a note about folders that are not arms of the study."""
        arms = {arm.name for arm in self.study.arms}
        others = sorted(
            path.name for path in self.folder.iterdir() if path.is_dir() and path.name not in arms
        )
        if others:
            yield f"Folders that the study does not list as arms were not read: {', '.join(others)}."

    def _untraced(self) -> Iterator[str]:
        """Yield a note on each arm with agents of another study whose trainings are not there."""
        for arm in self.study.arms:
            if (self.study.shared_agent(arm) or "").startswith(RUNS):
                places = _seeds(self.folder / arm.name)
                lost = [place for place in places if not _is_run(self._origin(arm, _seed(place)))]
                if lost:
                    agents = f"the trainings of {len(lost)} agents"
                    yield f"{arm.label}: {agents} were not found and are not checked."

    def _unexplained(self, parts: Sequence[Part]) -> Iterator[str]:
        """Yield a note on each evaluation whose arms differ in settings that no override of the study sets.

        The choices or defaults that the overrides start from have changed between the runs then.
        """
        for evaluation in (None, *self.study.evaluations):
            name = evaluation.name if evaluation else ITSELF
            runs = {part.arm: part.run for part in parts if part.evaluation == name}
            words = {word for arm in self.study.arms for word in arm.overrides}
            if evaluation:
                words |= {word for arm in self.study.arms for word in evaluation.words(arm.name, ())}
            else:
                trained = {arm.name for arm in self.study.arms if self.study.trains(arm)}
                runs = {arm: run for arm, run in runs.items() if arm in trained}
            explained = {setting(word) for word in words} | DERIVED
            names = set().union(*(compared_settings(run, explained) for run in runs.values()))
            odd = sorted(each for each in names if len({run.settings.get(each) for run in runs.values()}) > 1)
            if odd and "experiment" not in explained:
                values = ", ".join(dict.fromkeys(str(run.settings.get(odd[0])) for run in runs.values()))
                more = f"; {len(odd) - 1} more settings differ" if len(odd) > 1 else ""
                place = f"{evaluation.label}: " if evaluation else ""
                yield f"{place}{odd[0]} differs between arms ({values}) and no override sets it{more}."


def _behaviour(run: Run) -> dict[str, float]:
    """Return what an agent did in an evaluation beside its score."""
    found = {name: measured(run.results, name) for name in BEHAVIOUR}
    return {name: value for name, value in found.items() if value is not None}


def _fitting(run: Run, seed: int | None, agent: str) -> Run:
    """Return a run, with a problem if its place asks for another `seed` (or None) or `agent` (or "")."""
    if run.problem:
        return run
    if seed is not None and run.seed != seed:
        return replace(run, problem=f"its seed is {run.seed}, that of its place {seed}")
    asked = Path(agent.removeprefix(RUNS)).parts
    if agent and Path(run.agent).parts[-len(asked) :] != asked:
        return replace(run, problem=f"it evaluated {run.agent}, its place asks for {agent}")
    return run


def _is_run(folder: Path) -> bool:
    return (folder / CONFIG).is_file()


def _is_seed(name: str) -> bool:
    """Return True for "1" and "10", and False for "01" and digits of other scripts."""
    return name.isdecimal() and str(int(name)) == name


def _seed(place: Path) -> int:
    return int(place.name)


def _seeds(arm: Path) -> list[Path]:
    """Return the folders of an arm that are named by a seed, in order."""
    return sorted((path for path in arm.glob("*") if _is_seed(path.name)), key=_seed)


def _settings(ignored: set[str], part: Part) -> Hashable:
    return settings_key(part.run, ignored)


def _kind(part: Part) -> tuple[str, str]:
    return part.arm, part.evaluation


def _own_groups(parts: Sequence[Part], arm: str) -> set[str]:
    """Return the groups of settings that most agents of an arm have from a run of their own seed.

    As cart=runs/.../10/cart.yaml of the agent with seed 10. The track guard is fitted to them.
    """
    found = [_given_by_own_seed(part.run) for part in parts if _kind(part) == (arm, ITSELF)]
    counts = Counter(name for each in found for name in each)
    groups = {name for name, count in counts.items() if count > 1 and 2 * count > len(found)}
    return groups | {"guard"} if groups else groups


def _given_by_own_seed(run: Run) -> set[str]:
    """Return the settings that were given as a path through a folder named by the seed."""
    paths = {setting(word): PureWindowsPath(word.partition("=")[2]).parts for word in run.command}
    given = {name for name, parts in paths.items() if len(parts) > 1 and str(run.seed) in parts}
    return {name for name in given if not name.startswith("hydra.")} - {*FREE}


def _thinned(curve: Sequence[tuple[float, float]]) -> Curve:
    """Return at most CURVE_POINTS means of neighbouring points, so that no peak vanishes silently."""
    step = -(-len(curve) // CURVE_POINTS)
    chunks = [curve[start : start + step] for start in range(0, len(curve), step)]
    return tuple((chunk[-1][0], sum(value for _, value in chunk) / len(chunk)) for chunk in chunks)


def split_by_majority(
    items: Sequence[Item], key: Callable[[Item], Hashable]
) -> tuple[list[Item], list[tuple[Item, Hashable]]]:
    """Return the items with the most frequent key (the first of several), and the others with that key."""
    if not items:
        return [], []
    common, _ = Counter(map(key, items)).most_common(1)[0]
    same = [item for item in items if key(item) == common]
    return same, [(item, common) for item in items if key(item) != common]


def settings_key(run: Run, ignored: Collection[str] = ()) -> Hashable:
    """Return a key that runs with the same command and settings share, those of `ignored` groups aside."""
    return run.program, tuple((name, run.settings[name]) for name in sorted(compared_settings(run, ignored)))


def compared_settings(run: Run, ignored: Collection[str]) -> set[str]:
    """Return the names of the settings of a run that are in none of the `ignored` groups."""
    groups = tuple(f"{name}." for name in ignored)
    return {name for name in run.settings if name not in ignored and not name.startswith(groups)}


def settings_difference(run: Run, common: Run, ignored: Collection[str] = (), most: int = 3) -> str:
    """Return in words where the settings of `run` differ from those of `common`."""
    names = sorted(
        name
        for name in compared_settings(run, ignored) | compared_settings(common, ignored)
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


def _plain(value: Hashable) -> str:
    return "unset" if value is None else str(value)
