"""Reads the results of studies, from run folders or from small JSON files.

A folder of studies has a folder for each: study.yaml, and <arm>/<seed>/ with the run and its
evaluations/<evaluation>/. Runs that are unfinished, damaged, of other versions or settings than the rest, or
of another seed or agent than their place says, are named and do not count.
"""

import json
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path, PureWindowsPath
from typing import Any

from cartpole_rl.checking import checked
from cartpole_rl.choices import conf_folder
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.events import scalars
from cartpole_rl.reporting.studies.results import (
    OWN,
    STAGES,
    Agent,
    Curve,
    Exclusion,
    StudyResults,
    checked_name,
    from_json,
)
from cartpole_rl.reporting.studies.sections import OWN_FILES
from cartpole_rl.reporting.studies.settings import RUN, RUNS, SEED, Evaluation, Study, Variant, setting
from cartpole_rl.run_files import CONFIG
from cartpole_rl.workflows.pages.runs import (
    DAMAGE,
    FREE,
    Run,
    commits_note,
    compared_settings,
    learning_curve,
    measured,
    partly_measured_note,
    read_run,
    run_of,
    settings_difference,
    settings_key,
    short,
    split_by_majority,
)
from cartpole_rl.workflows.run_folder import write_json
from cartpole_rl.workflows.studies import STUDIES, read_study_file

STUDY, EVALUATIONS = "study.yaml", "evaluations"
EMULATOR = "emulator="
TEXTS = ("title", "order", "figure", "question", "thesis", "finding", "judged")  # of today's conf/study/
MADE = ("measure", "command", "experiment", "ratio", "agents_of")  # what the results depend on
TRAINING = ("train", "finetune")  # commands that make agents
DERIVED = {"evaluated", "guard"}  # settings that follow from others
ITSELF = ""  # evaluation of a part that is the run of an arm and a seed itself
LOSS = "learning/loss"  # TensorBoard's curve
CURVE_POINTS = 60


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


def read_studies(folder: Path) -> list[StudyResults]:
    """Return the results of the studies in `folder` in the order of the page.

    `folder` holds folders of studies or JSON files of `write_data`, or is the folder of one study. Where it
    holds several, those of conf/study/ that it lacks are added without results. Raises ConfigError.
    """
    if not folder.is_dir():
        raise ConfigError(f"studies={folder}: there is no such folder")
    if (folder / STUDY).is_file():
        return [read_study(folder)]
    places = sorted(path.parent for path in folder.glob(f"*/{STUDY}"))
    files = sorted(folder.glob("*.json"))
    if not places and not files:
        raise ConfigError(f"studies={folder}: it holds no study; give a folder that scripts/reproduce wrote")
    found = [read_study(place) for place in places] or _read_all_data(files)
    return sorted(_with_shipped(found), key=lambda each: (each.study.order, each.name))


def emulators(results: Sequence[StudyResults]) -> dict[str, str]:
    """Return the files of conf/emulator/ that the studies choose by emulator=<name>, by that name."""
    words = {
        word
        for each in results
        for variant in (*each.study.arms, *each.study.evaluations)
        for word in variant.overrides
    }
    names = sorted(word.removeprefix(EMULATOR) for word in words if word.startswith(EMULATOR))
    files = {name: conf_folder() / "emulator" / f"{name}.yaml" for name in names}
    return {name: file.read_text(encoding="utf-8") for name, file in files.items() if file.is_file()}


def write_data(results: Sequence[StudyResults], folder: Path) -> None:
    """Write a JSON file for each study that has agents."""
    for each in results:
        if each.agents:
            write_json(folder / f"{each.name}.json", each.as_json())


def _read_all_data(files: Sequence[Path]) -> list[StudyResults]:
    """Return the results in files of `write_data`, each study once. Raises ConfigError."""
    found = {file: read_data(file) for file in files}
    for file, results in found.items():
        if results.name != file.stem:
            raise ConfigError(
                f"studies={file}: it holds the study {results.name}; rename it to {results.name}.json, "
                "or remove it if it is a copy"
            )
    return [*found.values()]


def read_data(file: Path) -> StudyResults:
    """Return the results in a file of `write_data`. Raises ConfigError if it is damaged."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        study = checked(Study, content["study"])
        return _with_texts(from_json(content, study))
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}"
        raise ConfigError(f"studies={file} is damaged ({place}): restore it or remove it") from None
    except DAMAGE as error:
        message = f"studies={file} is not a file of results: {short(error)}; restore it or remove it"
        raise ConfigError(message) from None


def read_study(folder: Path) -> StudyResults:
    """Return the results in the folder of one study. Raises ConfigError."""
    name = _name_of(folder)
    study = read_study_file(folder / STUDY)
    if not study.size and folder.parent.name in study.sizes:
        study = study.model_copy(update={"size": folder.parent.name})
    parts, exclusions = [*_parts(folder, name, study)], [*_misnamed(folder, study), *_foreign(folder, study)]
    parts, unusable = _complete(parts)
    exclusions += unusable
    parts, others = _of_one_kind(parts)
    exclusions += others
    agents, unmeasured, curveless = _agents(folder, study, parts)
    counted = (part.run for part in parts if part.evaluation != ITSELF or not study.evaluations)
    notes = (
        *_unlisted(folder, study),
        *_untraced(folder, study),
        *_own_files(study, parts),
        *_unexplained(study, parts),
        commits_note(part.run for part in parts),
        partly_measured_note(counted, study.measure),
        *curveless,
    )
    results = StudyResults(
        name,
        study,
        tuple(agents),
        tuple(exclusions + unmeasured),
        tuple(note for note in notes if note),
        versions=parts[0].run.versions if parts else "",
        folder=folder.as_posix(),
    )
    return _with_texts(results)


def _name_of(folder: Path) -> str:
    """Return the name of the study in `folder`. Raises ConfigError."""
    try:
        return checked_name(folder.absolute().name)
    except ValueError as error:
        raise ConfigError(f"studies={folder}: {error}") from None


def _parts(folder: Path, name: str, study: Study) -> Iterator[Part]:
    """Yield every run of the study `name` that has a folder."""
    for arm in study.arms:
        for place, seed in _places(folder, study, arm):
            origin = _origin(folder, study, arm, seed)
            own = next((each for each in (place, origin) if _is_run(each)), place)
            if _is_run(own) or not study.evaluations or _trains(study, arm):
                named = int(own.name) if own.name.isdecimal() else None
                yield Part(arm.name, seed, ITSELF, _fitting(read_run(own), named, ""))
            for evaluation in study.evaluations:
                inner = place / EVALUATIONS / evaluation.name
                if inner.is_dir() or inner.is_symlink():
                    agent = _agent_of(name, study, arm, evaluation, seed)
                    yield Part(arm.name, seed, evaluation.name, _fitting(read_run(inner), seed, agent))


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


def _agent_of(name: str, study: Study, arm: Variant, evaluation: Evaluation, seed: int) -> str:
    """Return the agent that an evaluation must name, below RUNS if a study made it; empty if any will do."""
    words = [word for word in evaluation.words(arm.name, ()) if word.startswith(RUN)]
    named = words[-1].removeprefix(RUN) if words else study.shared_agent(arm)
    if named is None and study.command in TRAINING:
        named = f"{RUNS}{name}/{arm.name}/{SEED}"
    return (named or "").replace(SEED, str(seed))


def _trains(study: Study, arm: Variant) -> bool:
    """Return True if each seed of an arm has a training in its own folder."""
    return study.command in TRAINING and study.agent_of(arm) is None and not study.agents_of


def _origin(folder: Path, study: Study, arm: Variant, seed: int) -> Path:
    """Return the run of another study whose agent an arm evaluates; the arm's own where it trains one."""
    named = study.shared_agent(arm)
    if named is None:
        return folder / arm.name / str(seed)
    return run_of(Path(named.replace(RUNS, f"{folder.parent.as_posix()}/").replace(SEED, str(seed))))


def _is_run(folder: Path) -> bool:
    return (folder / CONFIG).is_file()


def _seeds(arm: Path) -> list[Path]:
    """Return the folders of an arm that are named by a seed, in order."""
    if not arm.is_dir():
        return []
    return sorted((path for path in arm.iterdir() if _is_seed(path.name)), key=lambda path: int(path.name))


def _places(folder: Path, study: Study, arm: Variant) -> Iterator[tuple[Path, int]]:
    """Yield the folders of an arm that belong to the size of the study, with their seeds."""
    size = study.sizes.get(study.size)
    for place in _seeds(folder / arm.name):
        if size is None or int(place.name) in size.every_seed:
            yield place, int(place.name)


def _foreign(folder: Path, study: Study) -> Iterator[Exclusion]:
    """Yield the folders of arms with other seeds than the size of the study has."""
    for arm in study.arms:
        kept = {place for place, _ in _places(folder, study, arm)}
        for place in _seeds(folder / arm.name):
            if place not in kept:
                every = study.sizes[study.size].every_seed
                asked = f"{every[0]} to {every[-1]}" if len(every) > 1 else str(every[0])
                yield Exclusion(place.as_posix(), f"its seed is none of size {study.size}, which has {asked}")


def _is_seed(name: str) -> bool:
    """Return True for "1" and "10", and False for "01" and digits of other scripts."""
    return name.isdecimal() and str(int(name)) == name


def _misnamed(folder: Path, study: Study) -> Iterator[Exclusion]:
    """Yield the folders of arms whose names look like a seed and are none."""
    for place in (place for arm in study.arms for place in sorted(folder.glob(f"{arm.name}/*"))):
        if place.name.isnumeric() and not _is_seed(place.name):
            yield Exclusion(place.as_posix(), "its name is no seed")


def _complete(parts: Sequence[Part]) -> tuple[list[Part], list[Exclusion]]:
    """Return the parts without problem, and the others; an agent whose own run has one is left out whole."""
    broken = {part.place for part in parts if part.evaluation == ITSELF and part.run.problem}
    exclusions = [Exclusion(_name(part.run), part.run.problem) for part in parts if part.run.problem]
    return [part for part in parts if not part.run.problem and part.place not in broken], exclusions


def _of_one_kind(parts: Sequence[Part]) -> tuple[list[Part], list[Exclusion]]:
    """Return the parts of the most frequent versions and, within an arm, settings; and the others."""
    parts, others = split_by_majority(parts, lambda part: part.run.versions)
    exclusions = [
        Exclusion(_name(part.run), f"other versions: {part.run.versions or 'unknown'} instead of {common}")
        for part, common in others
    ]
    odd = {part.place for part, _ in others if part.evaluation == ITSELF}

    def kind(part: Part) -> tuple[str, str]:
        return part.arm, part.evaluation

    kept: list[Part] = []
    own = {arm: _own_groups(parts, arm) for arm in {part.arm for part in parts}}
    for (arm, _), group in groupby(sorted(parts, key=kind), key=kind):
        ignored = own[arm] | {f"evaluated.{name}" for name in own[arm]}
        same, different = split_by_majority([*group], partial(_settings, ignored))
        kept += same
        for part, _ in different:
            difference = settings_difference(part.run, same[0].run, ignored)
            exclusions.append(Exclusion(_name(part.run), f"other settings: {difference}"))
            odd |= {part.place} if part.evaluation == ITSELF else set()
    # an agent whose own run is odd is left out whole
    return [part for part in kept if part.place not in odd], exclusions


def _settings(ignored: set[str], part: Part) -> Hashable:
    return settings_key(part.run, ignored)


def _own_groups(parts: Sequence[Part], arm: str) -> set[str]:
    """Return the groups of settings that most agents of an arm have from a run of their own seed.

    As cart=runs/.../10/cart.yaml of the agent with seed 10. The track guard is fitted to them.
    """
    found = [_given_by_own_seed(part.run) for part in parts if (part.arm, part.evaluation) == (arm, ITSELF)]
    counts = Counter(name for each in found for name in each)
    groups = {name for name, count in counts.items() if count > 1 and 2 * count > len(found)}
    return groups | {"guard"} if groups else groups


def _given_by_own_seed(run: Run) -> set[str]:
    """Return the settings that were given as a path through a folder named by the seed."""
    paths = {setting(word): PureWindowsPath(word.partition("=")[2]).parts for word in run.command}
    given = {name for name, parts in paths.items() if len(parts) > 1 and str(run.seed) in parts}
    return {name for name in given if not name.startswith("hydra.")} - {*FREE}


def _agents(
    folder: Path, study: Study, parts: Sequence[Part]
) -> tuple[list[Agent], list[Exclusion], list[str]]:
    """Return the agents with a measure, the runs without one, and notes on curves that cannot be read."""
    agents, exclusions, notes = [], [], []

    def place(part: Part) -> tuple[str, int]:
        return part.place

    for (arm, seed), group in groupby(sorted(parts, key=place), key=place):
        runs = {part.evaluation: part.run for part in group}
        values = _values(study, runs)
        for name, value in values.items():
            if value is None:
                run = runs.get(name, runs.get(ITSELF))
                assert run
                exclusions.append(Exclusion(_name(run), f"it has no {study.measure}"))
        present = {name: value for name, value in values.items() if value is not None}
        if present:
            path = (folder / arm / str(seed)).as_posix()
            variant = next(each for each in study.arms if each.name == arm)
            curves, note = _curves(study, runs.get(ITSELF), _origin(folder, study, variant, seed))
            notes += [note] if note else []
            agents.append(Agent(arm, seed, path, present, curves))
    order = [arm.name for arm in study.arms]
    return sorted(agents, key=lambda agent: (order.index(agent.arm), agent.seed)), exclusions, notes


def _values(study: Study, runs: Mapping[str, Run]) -> dict[str, float | None]:
    """Return the measure of each evaluation of an agent that was run."""
    if study.evaluations:
        return {
            each.name: measured(runs[each.name].results, study.measure)
            for each in study.evaluations
            if each.name in runs
        }
    own = runs[ITSELF].results
    if study.command == "finetune":
        comparison: Any = own.get("comparison", {})
        return {stage.name: measured(comparison.get(stage.name, {}), study.measure) for stage in STAGES}
    return {OWN.name: measured(own, study.measure)}


def _curves(study: Study, run: Run | None, origin: Path) -> tuple[dict[str, Curve], str]:
    """Return the curves of a training that the study shows, and a note if they are damaged.

    TensorBoard's are in its `origin`.
    """
    if run is None or run.program != "train":
        return {}, ""
    curves: dict[str, Sequence[tuple[float, float]]] = {}
    try:
        if "score" in study.curves:
            name, curve = learning_curve(run.folder, study.measure)
            curves[name] = curve
        if "loss" in study.curves:
            curves["loss"] = scalars(origin, LOSS)
    except Exception as error:  # whatever the reader of a damaged file raises
        return {}, f"The curves of {_name(run)} are not drawn: {short(error)}."
    return {name: _thinned(curve) for name, curve in curves.items() if len(curve) > 1}, ""


def _thinned(curve: Sequence[tuple[float, float]]) -> Curve:
    """Return at most CURVE_POINTS means of neighbouring points, so that no peak vanishes silently."""
    step = -(-len(curve) // CURVE_POINTS)
    chunks = [curve[start : start + step] for start in range(0, len(curve), step)]
    return tuple((chunk[-1][0], sum(value for _, value in chunk) / len(chunk)) for chunk in chunks)


def _unlisted(folder: Path, study: Study) -> list[str]:
    """Return a note about folders that are not arms of the study."""
    arms = {arm.name for arm in study.arms}
    others = sorted(path.name for path in folder.iterdir() if path.is_dir() and path.name not in arms)
    if not others:
        return []
    return [f"Folders that the study does not list as arms were not read: {', '.join(others)}."]


def _untraced(folder: Path, study: Study) -> Iterator[str]:
    """Yield a note on each arm with agents of another study whose trainings are not there."""
    for arm in study.arms:
        if not (study.shared_agent(arm) or "").startswith(RUNS):
            continue
        places = _seeds(folder / arm.name)
        lost = [place for place in places if not _is_run(_origin(folder, study, arm, int(place.name)))]
        if lost:
            yield f"{arm.label}: the trainings of {len(lost)} agents were not found and are not checked."


def _own_files(study: Study, parts: Sequence[Part]) -> Iterator[str]:
    """Yield a note on each arm whose agents have settings of their own, from runs of their seeds."""
    for arm in study.arms:
        if own := _own_groups(parts, arm.name):
            yield f"{arm.label}{OWN_FILES}{', '.join(sorted(own))}, from a run of its seed."


def _unexplained(study: Study, parts: Sequence[Part]) -> Iterator[str]:
    """Yield a note on each evaluation whose arms differ in settings that no override of the study sets.

    The choices or defaults that the overrides start from have changed between the runs then.
    """
    for evaluation in (None, *study.evaluations):
        name = evaluation.name if evaluation else ITSELF
        runs = {part.arm: part.run for part in parts if part.evaluation == name}
        words = {word for arm in study.arms for word in (*arm.overrides, *_own_words(evaluation, arm))}
        if evaluation is None:
            trained = {arm.name for arm in study.arms if _trains(study, arm)}
            runs = {arm: run for arm, run in runs.items() if arm in trained}
        explained = {setting(word) for word in words} | DERIVED
        names = set().union(*(compared_settings(run, explained) for run in runs.values()))
        odd = sorted(each for each in names if len({run.settings.get(each) for run in runs.values()}) > 1)
        if odd and "experiment" not in explained:
            values = ", ".join(dict.fromkeys(str(run.settings.get(odd[0])) for run in runs.values()))
            more = f"; {len(odd) - 1} more settings differ" if len(odd) > 1 else ""
            place = f"{evaluation.label}: " if evaluation else ""
            yield f"{place}{odd[0]} differs between arms ({values}) and no override sets it{more}."


def _own_words(evaluation: Evaluation | None, arm: Variant) -> Sequence[str]:
    return evaluation.words(arm.name, ()) if evaluation else ()


def _with_texts(results: StudyResults) -> StudyResults:
    """Return the results with the texts of today's conf/study/, which are written after the runs.

    A user's own study that has the name of a shipped one keeps its own.
    """
    file = STUDIES / f"{results.name}.yaml"
    if not file.is_file():
        return results
    today, then = read_study_file(file), results.study
    changed = _changes(then, today, results.label)
    if not changed:
        study = today.model_copy(update={"size": results.label})
    elif then.question == today.question or then.title == today.title:
        study = then.model_copy(update={name: getattr(today, name) for name in TEXTS})
    else:
        return results
    return replace(results, study=study, shipped=True, changed=tuple(changed))


def _changes(then: Study, today: Study, size: str) -> list[str]:
    """Return what today's study makes otherwise; labels make nothing."""
    changed = [name for name in MADE if getattr(then, name) != getattr(today, name)]
    changed += ["axis"] if (then.axis and then.axis.unit) != (today.axis and today.axis.unit) else []
    changed += ["arms"] if _unlabelled(then.arms) != _unlabelled(today.arms) else []
    changed += ["evaluations"] if _unlabelled(then.evaluations) != _unlabelled(today.evaluations) else []
    changed += [f"size {size}"] if size and then.sizes.get(size) != today.sizes.get(size) else []
    return changed


def _unlabelled(variants: Sequence[Variant]) -> list[dict[str, Any]]:
    """Return arms or evaluations without their labels, by name."""
    return [each.model_dump(exclude={"label"}) for each in sorted(variants, key=lambda each: each.name)]


def _with_shipped(found: Sequence[StudyResults]) -> list[StudyResults]:
    """Return `found` with the other studies of conf/study/, if it holds one of them."""
    if not any(each.shipped for each in found):
        return [*found]
    names = {each.name for each in found}
    files = [file for file in sorted(STUDIES.glob("*.yaml")) if file.stem not in names]
    return [*found, *(StudyResults(file.stem, read_study_file(file), shipped=True) for file in files)]


def _name(run: Run) -> str:
    return run.folder.as_posix()
