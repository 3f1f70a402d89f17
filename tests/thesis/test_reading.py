"""Studies are read from run folders and from their small files; runs that do not count are named."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from page_commands import ROOT
from reading import STUDY, read_studies, read_study
from results import Status, StudyResults, as_json, from_json, write_data
from study import STUDIES, read_study_file

from cartpole_rl.errors import ConfigError

Edit = Callable[[Path, Callable[[Any], object]], None]
HEAVY = "much/11/evaluations/heavy"
DAMAGE: dict[str, tuple[str, Callable[[Any], object]]] = {  # reason: file and change
    "unfinished: it has no metrics.json": ("", lambda content: None),
    "interrupted: 1 of 2 episodes": ("metrics.json", lambda content: content["episodes"].pop()),
    "other versions: cartpole_rl 0.1.0, torch 1.0": (
        "provenance.json",
        lambda content: content["packages"].update(torch="1.0"),
    ),
    "other settings: parameters.cart_mass 1.4 instead of 1.5": (
        "config.yaml",
        lambda content: content["parameters"].update(cart_mass=1.4),
    ),
    "it has no score_upright": ("metrics.json", lambda content: content.pop("score_upright")),
    "its seed is 10, that of its place 11": ("config.yaml", lambda content: content.update(seed=10)),
}


def excluded(results: StudyResults) -> dict[str, str]:
    return {each.run.removeprefix("quick/friction/"): each.reason for each in results.exclusions}


def test_every_agent_has_the_mean_score_of_its_evaluations(study: Path) -> None:
    results = read_study(study)
    places = [(agent.group, agent.seed) for agent in results.agents]
    assert places == [(arm, seed) for arm in ("little", "much") for seed in (10, 11, 12)]
    for agent in results.agents:
        for name, value in agent.values.items():
            metrics = json.loads((Path(agent.run) / "evaluations" / name / "metrics.json").read_text())
            assert value == metrics["score_upright"]["mean"]
            assert agent.behaviour[name]["upright_at_end"] == metrics["upright_at_end"]["mean"]
    stored = from_json(as_json(results), results.study)
    assert [agent.behaviour.keys() for agent in stored.agents] == [{"nominal", "heavy"}] * 6
    assert (results.exclusions, results.missing(), results.label) == ((), [], "quick")
    assert results.status() is Status.OPEN
    first, second = results.pairs("nominal", "heavy", "much")
    np.testing.assert_allclose(results.ratios("much"), second / first)


@pytest.mark.parametrize("reason", DAMAGE)
def test_a_run_that_does_not_fit_is_named_and_not_averaged(reason: str, study: Path, edit: Edit) -> None:
    whole = read_study(study).values("much", "heavy")
    file, change = DAMAGE[reason]
    if file:
        edit(study / HEAVY / file, change)
    else:
        (study / HEAVY / "metrics.json").unlink()
    results = read_study(study)
    assert [*excluded(results)] == [HEAVY]
    assert reason in excluded(results)[HEAVY]
    assert results.values("much", "heavy").tolist() == [whole[0], whole[2]]
    assert results.values("much", "nominal").shape == (3,)
    assert results.missing() == ["much friction, heavy cart: 2 of 3 seeds, 11 is missing"]
    assert results.status() is Status.INCOMPLETE


@pytest.mark.parametrize("files", ["config.yaml provenance.json", "config.yaml provenance.json metrics.json"])
def test_an_agent_whose_own_run_does_not_count_is_left_out_whole(files: str, study: Path, edit: Edit) -> None:
    for name in files.split():  # unfinished without metrics, else of other versions
        shutil.copy(study / HEAVY / name, study / "much/11" / name)
    edit(study / "much/11/provenance.json", lambda content: content["packages"].update(torch="1.0"))
    results = read_study(study)
    assert [*excluded(results)] == ["much/11"]
    assert results.values("much", "nominal").shape == (2,)


def test_folders_that_do_not_belong_are_named(study: Path) -> None:
    for name in ("7", "01", "\uff11", "\u00b2"):
        shutil.copytree(study / "much/10", study / "much" / name)
    shutil.copytree(study / "much", study / "most")
    shutil.rmtree(study / "little/12")
    results = read_study(study)
    assert excluded(results) == {
        **{f"much/{name}": "its name is no seed" for name in ("01", "\uff11", "\u00b2")},
        "much/7": "its seed is none of size quick, which has 10 to 12",
    }
    assert results.notes == ("Folders that the study does not list as arms were not read: most.",)
    assert results.missing()[0] == "little friction, nominal cart: 2 of 3 seeds, 12 is missing"


def as_trainings(study: Path, edit: Edit, little: str, evaluated: str = "") -> None:
    """Turn the study into one of trainings: `much` has one for each seed, `little` names its agent.

    The evaluations of `little` name the agents `evaluated`.
    """

    def rewrite(content: dict[str, Any]) -> None:
        content["command"] = "train"
        content["arms"][0]["overrides"], content["arms"][1]["overrides"] = [f"run={little}"], []

    edit(study / STUDY, rewrite)
    for place in (study / "much").glob("1?"):
        for name in ("config.yaml", "provenance.json", "metrics.json"):
            shutil.copy(place / "evaluations/heavy" / name, place / name)
        edit(place / "provenance.json", lambda content: content.update(program="cartpole-train"))
    for arm, agent in (("much", "quick/friction/much/{seed}"), ("little", evaluated or little)):
        for config in (study / arm).glob("*/evaluations/*/config.yaml"):
            named = agent.replace("{seed}", config.parts[-4])
            edit(config, lambda content, named=named: content.update(run=named))


@pytest.mark.parametrize("picked", ["", "/checkpoints/best.pt"])
def test_an_evaluation_of_another_agent_does_not_count(picked: str, study: Path, edit: Edit) -> None:
    agent = f"friction/much/{{seed}}{picked}"
    as_trainings(study, edit, f"{{runs}}/{agent}", f"/abs/quick/{agent}")
    assert read_study(study).exclusions == ()
    wrong = "little/11/evaluations/heavy"
    edit(study / wrong / "config.yaml", lambda content: content.update(run=f"quick/friction/much/12{picked}"))
    asked = f"its place asks for {{runs}}/friction/much/11{picked}"
    assert excluded(read_study(study)) == {wrong: f"it evaluated quick/friction/much/12{picked}, {asked}"}
    (study / "much/12/metrics.json").unlink()  # the training of an agent counts wherever it is
    edit(study / "much/11/provenance.json", lambda content: content["packages"].update(torch="1.0"))
    counted = {(each.group, each.seed) for each in read_study(study).agents}
    assert counted == {("much", 10), ("little", 10)}


def test_the_small_files_hold_the_same_results(study: Path) -> None:
    results, file = read_study(study), Path("data/friction.json")
    write_data([results], file.parent)
    (again,) = read_studies(file.parent)
    assert file.stat().st_size < 6000
    assert (again.study, again.digest, len(again.agents)) == (results.study, results.digest, 6)
    for content, message in (
        (file.read_text().replace('"friction"', '"other"'), "it holds the study other; rename it"),
        ('{"format": 1,\n', r"friction\.json is damaged \(line 2\): restore it or remove it"),
        ('{"format": 1}', "is not a file of results: 'study'"),
        ("[1]", "is not a file of results"),
    ):
        file.write_text(content)
        with pytest.raises(ConfigError, match=message):
            read_studies(file.parent)


def test_what_is_no_folder_of_studies_is_refused(study: Path) -> None:
    for folder, message in (("nowhere", "there is no such folder"), (study / "much", "it holds no study")):
        with pytest.raises(ConfigError, match=message):
            read_studies(Path(folder))
    study.rename("quick/x<b>y")
    with pytest.raises(ConfigError, match=r"^quick/x<b>y: 'x<b>y' is no name of a study; give letters"):
        read_studies(Path("quick"))


def shipped(tmp_path: Path, how: Callable[[dict[str, Any]], object]) -> StudyResults:
    """Stored results of a study of studies/ whose own copy was changed."""
    content = json.loads((ROOT / "docs/results/thesis/latency.json").read_text())
    how(content["study"])
    (tmp_path / "latency.json").write_text(json.dumps(content))
    return next(each for each in read_studies(tmp_path) if each.agents)


def test_labels_and_texts_of_a_shipped_study_are_those_of_today(tmp_path: Path, study: Path) -> None:
    def rename(content: dict[str, Any]) -> None:
        content["title"] = content["question"] = "Another question"
        content["arms"][0]["label"] += ", in other words"

    results, today = shipped(tmp_path, rename), read_study_file(STUDIES / "latency.yaml")
    assert results.study == today.model_copy(update={"size": "full"})
    assert (results.shipped, results.changed, results.finding is None) == (True, (), False)
    study.rename("quick/latency")  # an own study of that name keeps its texts
    (own,) = read_studies(Path("quick"))
    assert (own.study.question, own.shipped, own.remarks) == ("Does friction matter?", False, [])


def test_a_finding_is_not_shown_if_the_study_was_made_otherwise(tmp_path: Path) -> None:
    changes: dict[str, Callable[[dict[str, Any]], object]] = {
        "arms": lambda study: study["arms"][0]["overrides"].append("plant.substeps=1"),
        "evaluations": lambda study: study["evaluations"][0]["overrides"].append("plant.substeps=1"),
        "size full": lambda study: study["sizes"]["full"]["overrides"].append("learning.transitions=9"),
        "measure": lambda study: study.update(measure="score_upright"),
        "ratio": lambda study: study.update(ratio=not study["ratio"]),
    }
    for changed, how in changes.items():
        results = shipped(tmp_path, how)
        assert (results.changed, results.finding) == ((changed,), None)
        said = f"scripts/thesis/studies/latency.yaml has changed since these runs: {changed}."
        assert results.remarks == [said, "Its finding is not shown."]
