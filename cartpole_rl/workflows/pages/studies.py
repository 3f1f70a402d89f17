"""Reads the results of studies, from run folders or from small JSON files.

A folder of studies has a folder for each: study.yaml, and <arm>/<seed>/ with the run and its
evaluations/<evaluation>/. Runs that are unfinished, damaged, or of other versions or settings than the rest
are named and do not count.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
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
    from_json,
)
from cartpole_rl.reporting.studies.settings import Study, Variant
from cartpole_rl.run_files import CONFIG
from cartpole_rl.workflows.pages.runs import (
    Run,
    commits_note,
    learning_curve,
    measured,
    read_run,
    settings_difference,
    settings_key,
    split_by_majority,
)
from cartpole_rl.workflows.run_folder import write_json
from cartpole_rl.workflows.studies import STUDIES, read_study_file

STUDY, EVALUATIONS = "study.yaml", "evaluations"
EMULATOR = "emulator="
TEXTS = ("title", "order", "figure", "question", "thesis", "finding", "judged")  # of today's conf/study/
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
    found = [read_study(place) for place in places] or [read_data(file) for file in files]
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


def read_data(file: Path) -> StudyResults:
    """Return the results in a file of `write_data`. Raises ConfigError if it is damaged."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        study = checked(Study, content["study"])
        return _with_texts(from_json(content, study))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise ConfigError(f"studies={file} is not a file of results: {error}") from None


def read_study(folder: Path) -> StudyResults:
    """Return the results in the folder of one study."""
    study = read_study_file(folder / STUDY)
    if not study.size and folder.parent.name in study.sizes:
        study = study.model_copy(update={"size": folder.parent.name})
    parts, exclusions = [*_parts(folder, study)], []
    parts, unusable = _complete(parts)
    exclusions += unusable
    parts, others = _of_one_kind(parts)
    exclusions += others
    agents, unmeasured = _agents(folder, study, parts)
    notes = (*_unlisted(folder, study), commits_note(part.run for part in parts))
    results = StudyResults(
        folder.name,
        study,
        tuple(agents),
        tuple(exclusions + unmeasured),
        tuple(note for note in notes if note),
        versions=parts[0].run.versions if parts else "",
        folder=folder.as_posix(),
    )
    return _with_texts(results)


def _parts(folder: Path, study: Study) -> Iterator[Part]:
    """Yield every run of a study that has a folder."""
    for arm in study.arms:
        for place in _seeds(folder / arm.name):
            seed = int(place.name)
            own = next((each for each in (place, _origin(folder, study, arm, seed)) if _is_run(each)), place)
            if _is_run(own) or not study.evaluations:
                yield Part(arm.name, seed, OWN.name, read_run(own))
            for evaluation in study.evaluations:
                inner = place / EVALUATIONS / evaluation.name
                if inner.is_dir():
                    yield Part(arm.name, seed, evaluation.name, read_run(inner))


def _origin(folder: Path, study: Study, arm: Variant, seed: int) -> Path:
    """Return the run of another study whose agent an arm evaluates; the arm's own where it trains one."""
    if study.agents_of:
        return folder.parent / study.agents_of / arm.name / str(seed)
    named = study.agent_of(arm)
    if named is None:
        return folder / arm.name / str(seed)
    return Path(named.replace("{runs}", folder.parent.as_posix()).replace("{seed}", str(seed)))


def _is_run(folder: Path) -> bool:
    return (folder / CONFIG).is_file()


def _seeds(arm: Path) -> list[Path]:
    """Return the folders of an arm that are named by a seed, in order."""
    if not arm.is_dir():
        return []
    return sorted((path for path in arm.iterdir() if path.name.isdecimal()), key=lambda path: int(path.name))


def _complete(parts: Sequence[Part]) -> tuple[list[Part], list[Exclusion]]:
    """Return the parts without problem, and the others; an agent whose own run has one is left out whole."""
    broken = {part.place for part in parts if part.evaluation == OWN.name and part.run.problem}
    exclusions = [Exclusion(_name(part.run), part.run.problem) for part in parts if part.run.problem]
    return [part for part in parts if not part.run.problem and part.place not in broken], exclusions


def _of_one_kind(parts: Sequence[Part]) -> tuple[list[Part], list[Exclusion]]:
    """Return the parts of the most frequent versions and, within an arm, settings; and the others."""
    parts, others = split_by_majority(parts, lambda part: part.run.versions)
    exclusions = [
        Exclusion(_name(part.run), f"other versions: {part.run.versions or 'unknown'} instead of {common}")
        for part, common in others
    ]
    odd = {part.place for part, _ in others if part.evaluation == OWN.name}

    def kind(part: Part) -> tuple[str, str]:
        return part.arm, part.evaluation

    kept: list[Part] = []
    for _, group in groupby(sorted(parts, key=kind), key=kind):
        same, different = split_by_majority([*group], lambda part: settings_key(part.run))
        kept += same
        for part, _ in different:
            exclusions.append(
                Exclusion(_name(part.run), f"other settings: {settings_difference(part.run, same[0].run)}")
            )
            odd |= {part.place} if part.evaluation == OWN.name else set()
    # an agent whose own run is odd is left out whole
    return [part for part in kept if part.place not in odd], exclusions


def _agents(folder: Path, study: Study, parts: Sequence[Part]) -> tuple[list[Agent], list[Exclusion]]:
    """Return the agents with a measure, and the runs without one."""
    agents, exclusions = [], []

    def place(part: Part) -> tuple[str, int]:
        return part.place

    for (arm, seed), group in groupby(sorted(parts, key=place), key=place):
        runs = {part.evaluation: part.run for part in group}
        values = _values(study, runs)
        for name, value in values.items():
            if value is None:
                run = runs.get(name, runs.get(OWN.name))
                assert run
                exclusions.append(Exclusion(_name(run), f"it has no {study.measure}"))
        present = {name: value for name, value in values.items() if value is not None}
        if present:
            path = (folder / arm / str(seed)).as_posix()
            variant = next(each for each in study.arms if each.name == arm)
            curves = _curves(study, runs.get(OWN.name), _origin(folder, study, variant, seed))
            agents.append(Agent(arm, seed, path, present, curves))
    order = [arm.name for arm in study.arms]
    return sorted(agents, key=lambda agent: (order.index(agent.arm), agent.seed)), exclusions


def _values(study: Study, runs: Mapping[str, Run]) -> dict[str, float | None]:
    """Return the measure of each evaluation of an agent that was run."""
    if study.evaluations:
        return {
            each.name: measured(runs[each.name].results, study.measure)
            for each in study.evaluations
            if each.name in runs
        }
    own = runs[OWN.name].results
    if study.command == "finetune":
        comparison: Any = own.get("comparison", {})
        return {stage.name: measured(comparison.get(stage.name, {}), study.measure) for stage in STAGES}
    return {OWN.name: measured(own, study.measure)}


def _curves(study: Study, run: Run | None, origin: Path) -> dict[str, Curve]:
    """Return the curves of a training that the study shows; TensorBoard's are in its `origin`."""
    if run is None or run.program != "train":
        return {}
    curves: dict[str, Sequence[tuple[float, float]]] = {}
    if "score" in study.curves:
        name, curve = learning_curve(run.folder, study.measure)
        curves[name] = curve
    if "loss" in study.curves:
        curves["loss"] = scalars(origin, LOSS)
    return {name: _thinned(curve) for name, curve in curves.items() if len(curve) > 1}


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


def _with_texts(results: StudyResults) -> StudyResults:
    """Return the results with the texts of today's conf/study/, which are written after the runs."""
    file = STUDIES / f"{results.name}.yaml"
    if not file.is_file():
        return results
    today = read_study_file(file)
    texts = {name: getattr(today, name) for name in TEXTS}
    made = ("measure", "arms", "evaluations", "command", "experiment")
    changed = [name for name in made if getattr(today, name) != getattr(results.study, name)]
    note = (f"conf/study/{file.name} has changed since these runs: {', '.join(changed)}.",) if changed else ()
    return replace(results, study=results.study.model_copy(update=texts), notes=results.notes + note)


def _with_shipped(found: Sequence[StudyResults]) -> list[StudyResults]:
    """Return `found` with the other studies of conf/study/, if it holds one of them."""
    shipped = {file.stem: file for file in sorted(STUDIES.glob("*.yaml"))}
    names = {each.name for each in found}
    if not names & {*shipped}:
        return [*found]
    lacking = [
        StudyResults(name, read_study_file(file)) for name, file in shipped.items() if name not in names
    ]
    return [*found, *lacking]


def _name(run: Run) -> str:
    return run.folder.as_posix()
