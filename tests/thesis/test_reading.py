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
from results import Status, StudyResults, write_data
from study import STUDIES, read_study_file

from cartpole_rl.errors import ConfigError

Edit = Callable[[Path, Callable[[Any], object]], None]
HEAVY = "much/11/evaluations/heavy"


def test_every_agent_has_the_mean_score_of_its_evaluations(study: Path) -> None:
    results = read_study(study)
    assert [(agent.group, agent.seed) for agent in results.agents] == [
        (arm, seed) for arm in ("little", "much") for seed in (10, 11, 12)
    ]
    for agent in results.agents:
        for name, value in agent.values.items():
            metrics = json.loads((Path(agent.run) / "evaluations" / name / "metrics.json").read_text())
            assert value == metrics["score_upright"]["mean"]
    assert (results.exclusions, results.missing(), results.label) == ((), [], "quick")
    assert results.status() is Status.OPEN
    assert "torch" in results.versions
    first, second = results.pairs("nominal", "heavy", "much")
    np.testing.assert_allclose(results.ratios("much"), second / first)


def lose(run: Path, edit: Edit) -> None:
    (run / "metrics.json").unlink()


def cut_off(run: Path, edit: Edit) -> None:
    (run / "metrics.json").write_text((run / "metrics.json").read_text()[:100])


def interrupt(run: Path, edit: Edit) -> None:
    edit(run / "metrics.json", lambda content: content["episodes"].pop())


def other_version(run: Path, edit: Edit) -> None:
    edit(run / "provenance.json", lambda content: content["packages"].update(torch="1.0"))


def other_setting(run: Path, edit: Edit) -> None:
    edit(run / "config.yaml", lambda content: content["parameters"].update(cart_mass=1.4))


def no_number(run: Path, edit: Edit) -> None:
    edit(run / "metrics.json", lambda content: content.pop("score_upright"))


def other_seed(run: Path, edit: Edit) -> None:
    edit(run / "config.yaml", lambda content: content.update(seed=10))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lose, "unfinished: it has no metrics.json"),
        (cut_off, "damaged results: Expecting "),
        (interrupt, "interrupted: 1 of 2 episodes"),
        (other_version, "other versions: cartpole_rl 0.1.0, torch 1.0"),
        (other_setting, "other settings: parameters.cart_mass 1.4 instead of 1.5"),
        (no_number, "it has no score_upright"),
        (other_seed, "its seed is 10, that of its place 11"),
    ],
)
def test_a_run_that_does_not_fit_is_named_and_not_averaged(
    damage: Callable[[Path, Edit], None], reason: str, study: Path, edit: Edit
) -> None:
    whole = read_study(study).values("much", "heavy")
    damage(study / HEAVY, edit)
    results = read_study(study)
    (exclusion,) = results.exclusions
    assert exclusion.run == f"quick/friction/{HEAVY}"
    assert reason in exclusion.reason
    assert results.values("much", "heavy").tolist() == [whole[0], whole[2]]
    assert results.values("much", "nominal").shape == (3,)
    assert results.missing() == ["much friction, heavy cart: 2 of 3 seeds, 11 is missing"]
    assert results.status() is Status.INCOMPLETE


@pytest.mark.parametrize(
    "files", [("config.yaml", "provenance.json"), ("config.yaml", "provenance.json", "metrics.json")]
)
def test_an_agent_whose_own_run_does_not_count_is_left_out_whole(
    files: tuple[str, ...], study: Path, edit: Edit
) -> None:
    for name in files:  # unfinished without metrics, else of other versions
        shutil.copy(study / HEAVY / name, study / "much/11" / name)
    edit(study / "much/11/provenance.json", lambda content: content["packages"].update(torch="1.0"))
    results = read_study(study)
    assert [each.run for each in results.exclusions] == ["quick/friction/much/11"]
    assert results.values("much", "nominal").shape == (2,)


def test_folders_that_do_not_belong_are_named(study: Path) -> None:
    for name in ("7", "01", "\uff11", "\u00b2"):
        shutil.copytree(study / "much/10", study / "much" / name)
    shutil.copytree(study / "much", study / "most")
    shutil.rmtree(study / "little/12")
    results = read_study(study)
    names = {Path(each.run).name: each.reason for each in results.exclusions}
    foreign = names.pop("7")
    assert foreign == "its seed is none of size quick, which has 10 to 12"
    assert names == dict.fromkeys(("01", "\uff11", "\u00b2"), "its name is no seed")
    assert "Folders that the study does not list as arms were not read: most." in results.notes
    assert results.missing()[0] == "little friction, nominal cart: 2 of 3 seeds, 12 is missing"


def test_what_is_odd_about_runs_that_count_is_noted(study: Path, edit: Edit) -> None:
    edit(study / HEAVY / "provenance.json", lambda content: content.update(git_commit="abcdef0123456789"))
    edit(study / HEAVY / "metrics.json", lambda content: content["score_upright"].update(count=1))
    for config in study.glob("much/*/evaluations/heavy/config.yaml"):
        edit(config, lambda content: content["plant"].update(substeps=7))
    results = read_study(study)
    unexplained, commits, partial = results.notes
    assert unexplained == "heavy cart: plant.substeps differs between arms (4, 7) and no override sets it."
    assert "with the same package versions: " in commits
    assert "abcdef0123 (1)" in commits
    means = "1 of 2 episodes of 1 runs have it; their means are over these episodes."
    assert partial == f"score_upright: only {means}"
    assert results.exclusions == ()


def as_trainings(study: Path, edit: Edit, evaluated: str = "", **arms: str) -> None:
    """Turn the study into one of trainings, whose arms name their agent by run= or have a training each.

    The evaluations of `much` name its own agents, those of `little` the agents `evaluated`.
    """

    def rewrite(content: dict[str, Any]) -> None:
        content["command"] = "train"
        for arm in content["arms"]:
            arm["overrides"] = [f"run={arms[arm['name']]}"] if arms[arm["name"]] else []

    edit(study / STUDY, rewrite)
    for place in (place for arm, agent in arms.items() if not agent for place in (study / arm).glob("1?")):
        for name in ("config.yaml", "provenance.json", "metrics.json"):
            shutil.copy(place / "evaluations/heavy" / name, place / name)
        edit(place / "provenance.json", lambda content: content.update(program="cartpole-train"))
    for arm, agent in {"much": "quick/friction/much/{seed}", "little": evaluated or arms["little"]}.items():
        for config in (study / arm).glob("*/evaluations/*/config.yaml"):
            named = agent.replace("{seed}", config.parts[-4])
            edit(config, lambda content, named=named: content.update(run=named))


@pytest.mark.parametrize("picked", ["", "/checkpoints/best.pt"])
def test_an_evaluation_of_another_agent_does_not_count(picked: str, study: Path, edit: Edit) -> None:
    agent = f"friction/much/{{seed}}{picked}"
    as_trainings(study, edit, f"/abs/quick/{agent}", much="", little=f"{{runs}}/{agent}")
    assert read_study(study).exclusions == ()
    wrong = study / "little/11/evaluations/heavy"
    edit(wrong / "config.yaml", lambda content: content.update(run=f"quick/friction/much/12{picked}"))
    (exclusion,) = read_study(study).exclusions
    asked = f"its place asks for {{runs}}/friction/much/11{picked}"
    assert exclusion.run == wrong.as_posix()
    assert exclusion.reason == f"it evaluated quick/friction/much/12{picked}, {asked}"
    # the training of an agent counts wherever it is
    wrong = study / "much/12/metrics.json"
    wrong.unlink()
    edit(study / "much/11/provenance.json", lambda content: content["packages"].update(torch="1.0"))
    assert {(each.group, each.seed) for each in read_study(study).agents} == {("much", 10), ("little", 10)}


def test_an_arm_of_the_baseline_is_checked_too(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="lqr")
    assert read_study(study).exclusions == ()
    as_trainings(study, edit, "quick/friction/much/{seed}", much="", little="lqr")
    assert len(read_study(study).exclusions) == 6


def test_a_training_that_is_not_there_is_named(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, "quick/elsewhere/much/{seed}", much="", little="{runs}/elsewhere/much/{seed}")
    (study / "much/11/config.yaml").unlink()
    results = read_study(study)
    assert [(each.run, each.reason) for each in results.exclusions] == [
        ("quick/friction/much/11", "it has no config.yaml")
    ]
    assert "little friction: the trainings of 3 agents were not found and are not checked." in results.notes


def test_a_damaged_history_costs_its_curve_alone(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="lqr")
    for seed in (10, 11, 12):
        history = '{"transitions": 1, "score": 2, "score_upright": 3}\n' * 2
        (study / f"much/{seed}/history.jsonl").write_text(history if seed != 11 else '{"transitions": 1, "sc')
    results = read_study(study)
    assert results.exclusions == ()
    assert {agent.seed for agent in results.agents if agent.curves} == {10, 12}
    drawn = "quick/friction/much/11 are not drawn: line 1 of history.jsonl is damaged."
    assert f"The curves of {drawn}" in results.notes


def test_agents_may_have_settings_from_runs_of_their_own_seeds(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="lqr")
    for seed in (10, 11, 12):
        place = study / "much" / str(seed)
        edit(place / "config.yaml", lambda content, seed=seed: content.update(cart={"cart_mass": seed}))
        for heavy in place.glob("evaluations/*/config.yaml"):
            edit(heavy, lambda content, seed=seed: content["evaluated"]["cart"].update(cart_mass=seed))
    assert len(read_study(study).exclusions) == 2 + 4
    for seed in (10, 11, 12):
        words = ["cartpole-train", f"cart=runs/identified/{seed}/cart.yaml", f"seed={seed}"]
        edit(
            study / f"much/{seed}/provenance.json",
            lambda content, words=words: content.update(command=words),
        )
    results = read_study(study)
    assert results.exclusions == ()
    assert "much friction: each agent has its own cart, guard, from a run of its seed." in results.notes
    edit(study / "much/12/provenance.json", lambda content: content.update(command=["x", "pole=large"]))
    edit(study / "much/12/config.yaml", lambda content: content.update(pole={"choices": {}}))
    assert {each.run for each in read_study(study).exclusions} == {"quick/friction/much/12"}


def test_the_small_files_hold_the_same_results(study: Path, tmp_path: Path) -> None:
    results = read_study(study)
    write_data([results], tmp_path / "data")
    (again,) = read_studies(tmp_path / "data")
    assert (tmp_path / "data/friction.json").stat().st_size < 4000
    assert (again.study, again.digest) == (results.study, results.digest)
    for ours, theirs in zip(again.agents, results.agents, strict=True):
        assert (ours.group, ours.seed, ours.run) == (theirs.group, theirs.seed, theirs.run)
        assert ours.values == pytest.approx(theirs.values, rel=1e-5)
    shutil.copy(tmp_path / "data/friction.json", tmp_path / "data/friction_old.json")
    with pytest.raises(ConfigError, match=r"friction_old\.json: it holds the study friction; rename it"):
        read_studies(tmp_path / "data")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"format": 1,\n', r"friction\.json is damaged \(line 2\): restore it or remove it"),
        ('{"format": 1}', "is not a file of results: 'study'"),
        ("[1]", "is not a file of results"),
    ],
)
def test_a_damaged_small_file_is_refused(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "friction.json").write_text(content)
    with pytest.raises(ConfigError, match=message):
        read_studies(tmp_path)


def test_what_is_no_folder_of_studies_is_refused(study: Path, edit: Edit, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such folder"):
        read_studies(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="it holds no study"):
        read_studies(study / "much")
    study.rename("quick/x<b>y")
    with pytest.raises(ConfigError, match=r"^quick/x<b>y: 'x<b>y' is no name of a study; give letters"):
        read_studies(Path("quick"))


def shipped(tmp_path: Path, how: Callable[[dict[str, Any]], object]) -> StudyResults:
    """Stored results of a study of studies/ whose own copy was changed."""
    content = json.loads((ROOT / "docs/results/thesis/latency.json").read_text())
    how(content["study"])
    (tmp_path / "latency.json").write_text(json.dumps(content))
    return next(each for each in read_studies(tmp_path) if each.agents)


def test_labels_and_texts_of_a_shipped_study_are_those_of_today(tmp_path: Path) -> None:
    def rename(study: dict[str, Any]) -> None:
        study["title"] = study["question"] = "Another question"
        for arm in study["arms"]:
            arm["label"] += ", in other words"

    results, today = shipped(tmp_path, rename), read_study_file(STUDIES / "latency.yaml")
    assert (results.shipped, results.changed) == (True, ())
    assert results.study == today.model_copy(update={"size": "full"})
    assert results.finding


@pytest.mark.parametrize(
    ("how", "changed"),
    [
        (lambda study: study["arms"][0]["overrides"].append("plant.substeps=1"), "arms"),
        (lambda study: study["evaluations"][0]["overrides"].append("plant.substeps=1"), "evaluations"),
        (lambda study: study["sizes"]["full"]["overrides"].append("learning.transitions=9"), "size full"),
        (lambda study: study.update(measure="score_upright"), "measure"),
        (lambda study: study.update(ratio=not study["ratio"]), "ratio"),
    ],
)
def test_a_finding_is_not_shown_if_the_study_was_made_otherwise(
    how: Callable[[dict[str, Any]], object], changed: str, tmp_path: Path
) -> None:
    results = shipped(tmp_path, how)
    assert (results.changed, results.finding) == ((changed,), None)
    assert results.remarks == [
        f"scripts/thesis/studies/latency.yaml has changed since these runs: {changed}.",
        "Its finding is not shown.",
    ]


def test_an_own_study_with_the_name_of_a_shipped_one_keeps_its_texts(study: Path) -> None:
    study.rename("quick/latency")
    (results,) = read_studies(Path("quick"))
    assert results.study.question == "Does friction matter?"
    assert (results.shipped, results.finding, results.remarks) == (False, None, [])
