"""What a command says of itself, and choices of a user's own."""

from pathlib import Path

import pytest
import yaml
from command_line import TINY, console_script, in_process, outcome

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
    words = ["--config-dir=mine", "experiment=broom", "hydra.run.dir=run"]
    done = in_process("train", *words, *TINY, folder=tmp_path)
    assert done.code == 0, done.err
    config = yaml.safe_load((tmp_path / "run/config.yaml").read_text())
    assert list(config["pole"]["choices"]) == ["broomstick"]
    assert config["agent"]["gamma"] == 0.95
    evaluated = in_process("evaluate", "run=run", "episodes=1", folder=tmp_path)  # needs no --config-dir
    assert evaluated.code == 0, evaluated.err


def test_the_emulated_cart_ends_quietly_when_it_is_interrupted(tmp_path: Path) -> None:
    process = console_script("emulate", "emulator.clock=real", folder=tmp_path)
    assert process.stdout is not None
    assert '"port"' in process.stdout.readline()
    process.terminate()
    done = outcome(process, timeout=20)
    assert (done.code, done.err) == (0, "")
