"""Help of every command, and a user's own choices."""

import re
import shlex
from pathlib import Path

import pytest
import yaml
from command_line import in_process

from cartpole_rl import __version__
from cartpole_rl.checking import checked
from cartpole_rl.choices import conf_folder
from cartpole_rl.cli import VERBS
from cartpole_rl.composition import compose
from cartpole_rl.settings import Settings

COMMANDS = ("train", "evaluate", "emulate")
SHOWN = {
    "train": "pole: both, large, medium, range",
    **dict.fromkeys(COMMANDS[1:], "emulator: large, medium, stand_in, stand_in_large"),
}
SCHEMAS: dict[str, type[Settings]] = {name: verb.find(verb.settings) for name, verb in VERBS.items()}
WITHOUT_A_SETTING = {"train": {"experiment", "sweep"}}  # groups that set other groups, or what is swept


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_examples_and_choices(command: str, tmp_path: Path) -> None:
    done = in_process(command, "--help", folder=tmp_path)
    assert done.code == 0
    assert done.err == ""
    assert f"Examples\n  cartpole-{command}" in done.out
    assert f"\n  {SHOWN[command]}\n" in done.out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", SCHEMAS)
def test_help_shows_the_groups_that_the_command_reads_and_no_other(command: str, tmp_path: Path) -> None:
    """By the fields of its config: each group of conf/ fills the field of its name."""
    done = in_process(command, "--help", folder=tmp_path)
    assert done.code == 0
    groups = {path.name for path in conf_folder().iterdir() if path.is_dir()}
    shown = {line.partition(":")[0].strip() for line in done.out.splitlines() if re.match(r"  \w+: \w", line)}
    assert shown & groups == groups & SCHEMAS[command].model_fields.keys() | WITHOUT_A_SETTING.get(
        command, set()
    )


def examples(text: str) -> list[list[str]]:
    """The words of each example on a page of --help, without what it explains."""
    _, _, below = text.partition("Examples\n")
    lines = [line.strip() for line in below.partition("\n\n")[0].splitlines()]
    return [shlex.split(re.split(r" {3,}", line)[0]) for line in lines if line.startswith("cartpole-")]


@pytest.mark.parametrize("command", SCHEMAS)
def test_help_says_what_the_command_does_and_its_three_examples_compose(command: str, tmp_path: Path) -> None:
    name = f"cartpole-{command.replace('_', '-')}"
    page = in_process(command, "--help", folder=tmp_path).out
    assert page.startswith(f"{name} ")
    found = examples(page)
    assert len(found) == 3
    for program, *words in found:
        assert program == name
        one_job = "-m" in words
        words = [word.partition(",")[0] if one_job else word for word in words if word != "-m"]
        if command != "find_port":
            checked(SCHEMAS[command], compose(command, words))


@pytest.mark.parametrize("command", SCHEMAS)
def test_help_names_pages_that_exist(command: str, tmp_path: Path) -> None:
    pages = re.findall(r"docs/[\w-]+\.md", in_process(command, "--help", folder=tmp_path).out)
    assert pages
    assert [page for page in pages if not Path(conf_folder().parent, page).is_file()] == []


def test_version_is_that_of_the_package(tmp_path: Path) -> None:
    done = in_process("train", "--version", folder=tmp_path)
    assert (done.code, done.out) == (0, f"cartpole_rl {__version__}\n")


@pytest.mark.parametrize(
    ("command", "plants"), [("train", "learned, simulated"), ("finetune", "emulated, serial")]
)
def test_help_shows_the_plants_that_the_command_takes(command: str, plants: str, tmp_path: Path) -> None:
    assert f"\n  plant: {plants}\n" in in_process(command, "--help", folder=tmp_path).out


def test_help_shows_a_users_own_choices(tmp_path: Path) -> None:
    (tmp_path / "mine/pole").mkdir(parents=True)
    (tmp_path / "mine/pole/broomstick.yaml").write_text("choices: {}\n")
    done = in_process("train", "--config-dir=mine", "--help", folder=tmp_path)
    assert "\n  pole: both, broomstick, large, medium, range\n" in done.out


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


def test_a_folder_of_a_users_own_choices_is_added(tmp_path: Path) -> None:
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
    composed = yaml.safe_load(done.out)
    assert list(composed["pole"]["choices"]) == ["broomstick"]
    assert composed["agent"]["gamma"] == 0.95
    assert composed["task"]["name"] == "swingup"
