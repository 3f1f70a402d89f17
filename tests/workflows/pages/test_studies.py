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
from cartpole_rl.workflows.pages.studies import read_data, read_studies, read_study, write_data

Edit = Callable[[Path, Callable[[Any], object]], None]
HEAVY = "much/1/evaluations/heavy"


def test_every_agent_has_the_mean_score_of_its_evaluations(study: Path) -> None:
    results = read_study(study)
    assert [(agent.arm, agent.seed) for agent in results.agents] == [
        (arm, seed) for arm in ("little", "much") for seed in (0, 1, 2)
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
    assert "score (6.1) (heavy cart): highest" in main
    assert "(3 agents)" in main
    assert f"{found.value:.1f}" in main
    assert ratio.startswith("Ratio of heavy cart to nominal cart: highest")
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
    assert results.missing() == ["much friction, heavy cart: 2 of 3 seeds"]
    assert status(results) is Status.INCOMPLETE


def test_a_missing_seed_is_named(study: Path) -> None:
    shutil.rmtree(study / "little/2")
    assert read_study(study).missing() == [
        "little friction, nominal cart: 2 of 3 seeds",
        "little friction, heavy cart: 2 of 3 seeds",
    ]


def test_an_agent_whose_training_is_unfinished_does_not_count(study: Path) -> None:
    for name in ("config.yaml", "provenance.json"):
        shutil.copy(study / HEAVY / name, study / "much/1" / name)
    results = read_study(study)
    assert [each.run for each in results.exclusions] == ["quick/friction/much/1"]
    assert results.values("much", "nominal").shape == (2,)


def test_an_agent_whose_training_is_of_other_versions_does_not_count(study: Path, edit: Edit) -> None:
    for name in ("config.yaml", "provenance.json", "metrics.json"):
        shutil.copy(study / HEAVY / name, study / "much/1" / name)
    edit(study / "much/1/provenance.json", lambda content: content["packages"].update(torch="1.0"))
    results = read_study(study)
    assert [each.run for each in results.exclusions] == ["quick/friction/much/1"]
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
        ("{", "is not a file of results"),
        ('{"format": 1}', "is not a file of results: 'study'"),
        ("[1]", "is not a file of results"),
    ],
)
def test_a_damaged_small_file_is_refused(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "friction.json").write_text(content)
    with pytest.raises(ConfigError, match=message):
        read_studies(tmp_path)


def test_folders_without_studies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no such folder"):
        read_studies(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="it holds no study"):
        read_studies(tmp_path)


def test_a_wrong_study_is_refused_with_its_file_and_key(study: Path, edit: Edit) -> None:
    edit(study / "study.yaml", lambda content: content.update(colour="red"))
    with pytest.raises(ConfigError, match=r"study\.yaml: colour: there is no such setting"):
        read_study(study)
