"""What a command says of itself, and choices of a user's own."""

from pathlib import Path

import pytest
import yaml
from command_line import in_process

COMMANDS = ("train", "evaluate", "emulate")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_examples_and_choices(command: str, tmp_path: Path) -> None:
    done = in_process(command, "--help", folder=tmp_path)
    assert done.code == 0
    assert done.err == ""
    assert f"Examples\n  cartpole-{command}" in done.out
    assert "\nemulator: large, medium" in done.out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", COMMANDS)
def test_cfg_job_shows_every_setting(command: str, tmp_path: Path) -> None:
    done = in_process(command, "--cfg", "job", folder=tmp_path)
    assert done.code == 0
    assert done.err == ""
    shown = yaml.safe_load(done.out)
    expected = {"train": "learning", "evaluate": "episodes", "emulate": "emulator"}[command]
    assert expected in shown
    assert "hydra" not in shown
    assert not list(tmp_path.iterdir())


def test_a_folder_of_ones_own_choices_is_added(tmp_path: Path) -> None:
    (tmp_path / "mine/pole").mkdir(parents=True)
    (tmp_path / "mine/experiment").mkdir()
    (tmp_path / "mine/pole/broomstick.yaml").write_text(
        "choices: {broomstick: {pole_mass: 0.3, pole_com: 0.6, pole_inertia: 0.036}}\n"
    )
    (tmp_path / "mine/experiment/broom.yaml").write_text(
        "# @package _global_\ndefaults: [override /pole: broomstick]\nagent: {gamma: 0.95}\n"
    )
    done = in_process("train", "--config-dir=mine", "experiment=broom", "--cfg", "job", folder=tmp_path)
    assert done.code == 0, done.err
    config = yaml.safe_load(done.out)
    assert list(config["pole"]["choices"]) == ["broomstick"]
    assert config["agent"]["gamma"] == 0.95
    assert config["task"]["name"] == "swingup"
