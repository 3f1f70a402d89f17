"""Studies are read from run folders and from their small files; runs that do not count are named."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.answers import Status, answer, status
from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.workflows.pages.studies import read_data, read_studies, read_study, write_data
from cartpole_rl.workflows.studies import STUDIES, read_study_file

Edit = Callable[[Path, Callable[[Any], object]], None]
DATA = Path(__file__).parents[3] / "docs/results/thesis"
HEAVY = "much/11/evaluations/heavy"


def test_every_agent_has_the_mean_score_of_its_evaluations(study: Path) -> None:
    results = read_study(study)
    assert [(agent.arm, agent.seed) for agent in results.agents] == [
        (arm, seed) for arm in ("little", "much") for seed in (10, 11, 12)
    ]
    for agent in results.agents:
        for name, value in agent.values.items():
            metrics = json.loads((Path(agent.run) / "evaluations" / name / "metrics.json").read_text())
            assert value == metrics["score_upright"]["mean"]
    assert results.values("much", "heavy").shape == (3,)
    assert (results.exclusions, results.missing(), results.label) == ((), [], "quick")
    assert "torch" in results.versions
    first, second = results.pairs("nominal", "heavy", "much")
    np.testing.assert_allclose(results.ratios("much"), second / first)


def test_the_answer_has_intervals_and_numbers_of_agents(study: Path) -> None:
    results = read_study(study)
    main, ratio = answer(results)
    found = results.estimate("much", "heavy")
    assert found is not None
    assert main.startswith("Score (6.1), heavy cart: ")
    assert main.endswith("; 3 agents each.")
    assert f"much friction {found.value:.1f} (" in main
    assert ratio.startswith("Ratio of heavy cart to nominal cart: ")
    assert status(results) is Status.OPEN


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


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lose, "unfinished: it has no metrics.json"),
        (cut_off, "damaged results: Expecting value: line "),
        (interrupt, "interrupted: 1 of 2 episodes"),
        (other_version, "other versions: cartpole_rl 0.1.0, torch 1.0"),
        (other_setting, "other settings: parameters.cart_mass 1.4 instead of 1.5"),
        (no_number, "it has no score_upright"),
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
    assert results.ratios("much").shape == (2,)
    assert results.missing() == ["much friction, heavy cart: 2 of 3 seeds, 11 is missing"]
    assert status(results) is Status.INCOMPLETE


def test_a_missing_seed_is_named(study: Path) -> None:
    shutil.rmtree(study / "little/12")
    assert read_study(study).missing() == [
        "little friction, nominal cart: 2 of 3 seeds, 12 is missing",
        "little friction, heavy cart: 2 of 3 seeds, 12 is missing",
    ]


def test_an_agent_whose_training_is_unfinished_does_not_count(study: Path) -> None:
    for name in ("config.yaml", "provenance.json"):
        shutil.copy(study / HEAVY / name, study / "much/11" / name)
    results = read_study(study)
    assert [each.run for each in results.exclusions] == ["quick/friction/much/11"]
    assert results.values("much", "nominal").shape == (2,)


def test_an_agent_whose_training_is_of_other_versions_does_not_count(study: Path, edit: Edit) -> None:
    for name in ("config.yaml", "provenance.json", "metrics.json"):
        shutil.copy(study / HEAVY / name, study / "much/11" / name)
    edit(study / "much/11/provenance.json", lambda content: content["packages"].update(torch="1.0"))
    results = read_study(study)
    assert [each.run for each in results.exclusions] == ["quick/friction/much/11"]
    assert results.values("much", "nominal").shape == (2,)


def test_runs_of_several_commits_are_noted(study: Path, edit: Edit) -> None:
    edit(study / HEAVY / "provenance.json", lambda content: content.update(git_commit="abcdef0123456789"))
    (note,) = (note for note in read_study(study).notes if "commits" in note)
    assert "with the same package versions: " in note
    assert "abcdef0123 (1)" in note


def test_folders_that_are_no_arms_are_noted(study: Path) -> None:
    shutil.copytree(study / "much", study / "most")
    assert "Folders that the study does not list as arms were not read: most." in read_study(study).notes


def test_the_small_files_hold_the_same_results(study: Path, tmp_path: Path) -> None:
    results = read_study(study)
    write_data([results], tmp_path / "data")
    file = tmp_path / "data/friction.json"
    again = read_data(file)
    assert file.stat().st_size < 4000
    assert [(agent.arm, agent.seed, agent.run) for agent in again.agents] == [
        (agent.arm, agent.seed, agent.run) for agent in results.agents
    ]
    for ours, theirs in zip(again.agents, results.agents, strict=True):
        assert ours.values == pytest.approx(theirs.values, rel=1e-5)
    assert again.study == results.study
    assert [each.name for each in read_studies(tmp_path / "data")] == ["friction"]


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


def test_a_copy_of_a_small_file_is_refused(study: Path, tmp_path: Path) -> None:
    write_data([read_study(study)], tmp_path / "data")
    shutil.copy(tmp_path / "data/friction.json", tmp_path / "data/friction_old.json")
    with pytest.raises(ConfigError, match=r"friction_old\.json: it holds the study friction; rename it"):
        read_studies(tmp_path / "data")


def test_agents_may_have_settings_from_runs_of_their_own_seeds(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="lqr")
    evaluate(study, edit, "much", "quick/friction/much/{seed}")
    for seed in (10, 11, 12):
        place = study / "much" / str(seed)
        edit(place / "config.yaml", lambda content, seed=seed: content.update(cart={"cart_mass": seed}))
        for heavy in place.glob("evaluations/*/config.yaml"):
            edit(heavy, lambda content, seed=seed: content["evaluated"]["cart"].update(cart_mass=seed))
    assert len(read_study(study).exclusions) == 2 + 4
    for seed in (10, 11, 12):
        words = ["cartpole-train", f"cart=runs/identified/{seed}/cart.yaml", f"seed={seed}"]
        edit(
            study / f"much/{seed}/provenance.json", lambda content, words=words: content.update(command=words)
        )
    results = read_study(study)
    assert results.exclusions == ()
    assert "much friction: each agent has its own cart, guard, from a run of its seed." in results.notes
    edit(study / "much/12/provenance.json", lambda content: content.update(command=["x", "pole=large"]))
    edit(study / "much/12/config.yaml", lambda content: content.update(pole={"choices": {}}))
    assert {each.run for each in read_study(study).exclusions} == {"quick/friction/much/12"}


def test_arms_that_no_override_tells_apart_are_named(study: Path, edit: Edit) -> None:
    assert not [note for note in read_study(study).notes if "differs between arms" in note]
    for config in study.glob("much/*/evaluations/heavy/config.yaml"):
        edit(config, lambda content: content["plant"].update(substeps=7))
    assert "heavy cart: plant.substeps differs between arms (4, 7) and no override sets it." in (
        read_study(study).notes
    )


def test_folders_without_studies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such folder"):
        read_studies(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="it holds no study"):
        read_studies(tmp_path)


def test_a_wrong_study_is_refused_with_its_file_and_key(study: Path, edit: Edit) -> None:
    edit(study / "study.yaml", lambda content: content.update(colour="red"))
    with pytest.raises(ConfigError, match=r"study\.yaml: colour: there is no such setting"):
        read_study(study)


def test_a_run_of_another_seed_than_its_folder_does_not_count(study: Path) -> None:
    shutil.copytree(study / "much/10", study / "much/7")
    shutil.rmtree(study / "little/11/evaluations/heavy")
    shutil.copytree(study / "little/10/evaluations/heavy", study / "little/11/evaluations/heavy")
    results = read_study(study)
    assert {each.run: each.reason for each in results.exclusions} == {
        "quick/friction/little/11/evaluations/heavy": "its seed is 10, that of its place 11",
        "quick/friction/much/7": "its seed is none of size quick, which has 10 to 12",
    }
    assert results.values("much", "heavy").size == 3
    assert results.values("little", "heavy").size == 2


@pytest.mark.parametrize("name", ["01", "\uff11", "\u00b2"])
def test_a_folder_whose_name_is_no_seed_is_named(name: str, study: Path) -> None:
    shutil.copytree(study / "much/11", study / "much" / name)
    results = read_study(study)
    assert [(each.run, each.reason) for each in results.exclusions] == [
        (f"quick/friction/much/{name}", "its name is no seed")
    ]
    assert results.values("much", "heavy").size == 3


def as_trainings(study: Path, edit: Edit, **arms: str) -> None:
    """Turn the study into one of trainings, whose arms name their agent by run= or have a training each."""
    edit(
        study / "study.yaml",
        lambda content: content.update(
            command="train",
            arms=[
                {**arm, "overrides": [f"run={arms[arm['name']]}"] if arms[arm["name"]] else []}
                for arm in content["arms"]
            ],
        ),
    )
    for place in (place for arm, agent in arms.items() if not agent for place in (study / arm).glob("1?")):
        for name in ("config.yaml", "provenance.json", "metrics.json"):
            shutil.copy(place / "evaluations/heavy" / name, place / name)


def evaluate(study: Path, edit: Edit, arm: str, agent: str) -> None:
    """Set the agent that the evaluations of an arm name; `{seed}` stands for the seed."""
    for config in (study / arm).glob("*/evaluations/*/config.yaml"):
        seed = config.parts[-4]
        edit(config, lambda content, seed=seed: content.update(run=agent.replace("{seed}", seed)))


@pytest.mark.parametrize("picked", ["", "/checkpoints/best.pt"])
def test_an_evaluation_of_another_agent_does_not_count(picked: str, study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little=f"{{runs}}/friction/much/{{seed}}{picked}")
    evaluate(study, edit, "much", "/abs/quick/friction/much/{seed}")
    evaluate(study, edit, "little", f"quick/friction/much/{{seed}}{picked}")
    assert read_study(study).exclusions == ()
    wrong = study / "little/11/evaluations/heavy"
    edit(wrong / "config.yaml", lambda content: content.update(run=f"quick/friction/much/12{picked}"))
    (exclusion,) = read_study(study).exclusions
    assert exclusion.run == wrong.as_posix()
    assert exclusion.reason == (
        f"it evaluated quick/friction/much/12{picked}, its place asks for {{runs}}/friction/much/11{picked}"
    )


def test_an_arm_of_the_baseline_is_checked_too(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="lqr")
    evaluate(study, edit, "much", "quick/friction/much/{seed}")
    assert read_study(study).exclusions == ()
    evaluate(study, edit, "little", "quick/friction/much/{seed}")
    assert len(read_study(study).exclusions) == 6


@pytest.mark.parametrize("picked", ["", "/checkpoints/best.pt"])
def test_the_training_of_an_agent_counts_wherever_it_is(picked: str, study: Path, edit: Edit) -> None:
    agent = f"friction/much/{{seed}}{picked}"
    as_trainings(study, edit, much="", little=f"{{runs}}/{agent}")
    evaluate(study, edit, "much", "quick/friction/much/{seed}")
    evaluate(study, edit, "little", f"quick/{agent}")
    (study / "much/12/metrics.json").unlink()
    edit(study / "much/11/provenance.json", lambda content: content["packages"].update(torch="1.0"))
    counted = {(agent.arm, agent.seed) for agent in read_study(study).agents}
    assert counted == {("much", 10), ("little", 10)}


def test_a_training_that_is_not_there_is_named(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="{runs}/elsewhere/much/{seed}")
    evaluate(study, edit, "much", "quick/friction/much/{seed}")
    evaluate(study, edit, "little", "quick/elsewhere/much/{seed}")
    (study / "much/11/config.yaml").unlink()
    results = read_study(study)
    assert [(each.run, each.reason) for each in results.exclusions] == [
        ("quick/friction/much/11", "it has no config.yaml")
    ]
    assert results.values("much", "nominal").size == 2
    assert "little friction: the trainings of 3 agents were not found and are not checked." in results.notes


def test_a_damaged_history_costs_its_curve_alone(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="lqr")
    evaluate(study, edit, "much", "quick/friction/much/{seed}")
    for seed in (10, 11, 12):
        edit(study / f"much/{seed}/provenance.json", lambda content: content.update(program="cartpole-train"))
        history = '{"transitions": 1, "score": 2, "score_upright": 3}\n' * 2
        (study / f"much/{seed}/history.jsonl").write_text(history)
    (study / "much/11/history.jsonl").write_text('{"transitions": 1, "sc')
    results = read_study(study)
    assert results.exclusions == ()
    assert {agent.seed for agent in results.agents if agent.curves} == {10, 12}
    assert (
        "The curves of quick/friction/much/11 are not drawn: line 1 of history.jsonl is damaged."
        in results.notes
    )


def test_means_over_a_part_of_the_episodes_are_noted(study: Path, edit: Edit) -> None:
    edit(study / HEAVY / "metrics.json", lambda content: content["score_upright"].update(count=1))
    assert (
        "score_upright: only 1 of 2 episodes of 1 runs have it; their means are over these episodes."
        in read_study(study).notes
    )


def shipped(tmp_path: Path, how: Callable[[dict[str, Any]], object]) -> StudyResults:
    """Results of a study of conf/study/ whose own copy was changed."""
    content = json.loads((DATA / "latency.json").read_text())
    how(content)
    (tmp_path / "latency.json").write_text(json.dumps(content))
    return read_data(tmp_path / "latency.json")


def rename(content: dict[str, Any]) -> None:
    content["study"]["title"] = content["study"]["question"] = "Another question"
    for arm in content["study"]["arms"]:
        arm["label"] += ", in other words"


def test_labels_and_texts_of_a_shipped_study_are_those_of_today(tmp_path: Path) -> None:
    today = read_study_file(STUDIES / "latency.yaml")
    results = shipped(tmp_path, rename)
    assert (results.shipped, results.changed, results.study) == (
        True,
        (),
        today.model_copy(update={"size": "full"}),
    )


@pytest.mark.parametrize(
    ("how", "changed"),
    [
        (lambda study: study["arms"][0]["overrides"].append("plant.substeps=1"), ("arms",)),
        (lambda study: study["evaluations"][0]["overrides"].append("plant.substeps=1"), ("evaluations",)),
        (lambda study: study["sizes"]["full"]["overrides"].append("learning.transitions=9"), ("size full",)),
        (lambda study: study.update(measure="score_upright"), ("measure",)),
        (lambda study: study.update(ratio=not study["ratio"]), ("ratio",)),
    ],
)
def test_a_finding_is_not_shown_if_the_study_was_made_otherwise(
    how: Callable[[dict[str, Any]], object], changed: tuple[str, ...], tmp_path: Path
) -> None:
    results = shipped(tmp_path, lambda content: how(content["study"]))
    assert (results.changed, results.finding) == (changed, None)
    assert results.remarks == [
        f"conf/study/latency.yaml has changed since these runs: {', '.join(changed)}.",
        "Its finding is not shown.",
    ]


def test_an_own_study_with_the_name_of_a_shipped_one_keeps_its_texts(study: Path) -> None:
    study.rename("quick/latency")
    results = read_study(Path("quick/latency"))
    assert results.study.question == "Does friction matter?"
    assert (results.shipped, results.finding, results.remarks) == (False, None, [])
    assert [each.name for each in read_studies(Path("quick"))] == ["latency"]


def test_a_study_needs_a_name_that_files_can_have(study: Path) -> None:
    study.rename("quick/x<b>y")
    with pytest.raises(
        ConfigError, match=r"^studies=quick/x<b>y: 'x<b>y' is no name of a study; give letters"
    ):
        read_studies(Path("quick"))


def test_an_evaluation_may_be_called_own(study: Path, edit: Edit) -> None:
    as_trainings(study, edit, much="", little="lqr")
    evaluate(study, edit, "much", "quick/friction/much/{seed}")
    edit(study / "study.yaml", lambda content: content["evaluations"][0].update(name="own"))
    for nominal in [*study.glob("*/*/evaluations/nominal")]:
        nominal.rename(nominal.with_name("own"))
    for seed in (10, 11, 12):
        edit(study / f"much/{seed}/provenance.json", lambda content: content.update(program="cartpole-train"))
    results = read_study(study)
    assert results.exclusions == ()
    assert results.values("much", "own").size == results.values("much", "heavy").size == 3
