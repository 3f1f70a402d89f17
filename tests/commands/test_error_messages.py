"""Errors of Hydra and of the operating system as one line with a remedy."""

import errno
from pathlib import Path

import pytest
from command_line import in_process
from hydra.errors import HydraException
from omegaconf.errors import ConfigKeyError

from cartpole_rl.choices import WHOLE, default_choices
from cartpole_rl.command import wrong_option
from cartpole_rl.composition import error_message, known_settings
from cartpole_rl.errors import ConfigError
from cartpole_rl.exits import one_line


def hydra_complaint(text: str, command: str, *words: str) -> str:
    return error_message(HydraException(text), command, words)


def test_a_file_error_names_the_file_and_the_reason() -> None:
    assert one_line(FileNotFoundError(errno.ENOENT, "No such file", "agent.pt"), "train") == (
        "agent.pt: No such file"
    )


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_gets_a_remedy(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    remedy = "; make room, or give hydra.run.dir= or hydra.sweep.dir= a folder on another disk"
    assert one_line(OSError(number, "is full", "last.pt"), "train") == f"last.pt: is full{remedy}"
    unnamed = "a file was not written: is full"
    assert one_line(OSError(number, "is full"), "train") == f"{unnamed}{remedy}"
    monkeypatch.setattr("sys.argv", ["cartpole-train", "resume=run"])  # its folder is given
    assert one_line(OSError(number, "is full"), "train") == f"{unnamed}; make room"


@pytest.mark.parametrize("words", ["", "-m seed=0,1"])
def test_a_folder_of_runs_that_cannot_be_made_is_named(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(command: str, label: str) -> str:
        raise OSError(errno.EROFS, "Read-only file system", f"runs/{command}")

    monkeypatch.setattr("cartpole_rl.sweeps.new_folder", refuse)
    done = in_process("train", *words.split(), folder=tmp_path)
    remedy = "give hydra.run.dir= or hydra.sweep.dir= another folder"
    assert done.complaint == f"cartpole-train: runs/train: Read-only file system; {remedy}"


def test_hydra_prints_no_errors_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    done = in_process("train", "pole=unknown", folder=tmp_path)
    assert (done.code, "pole=unknown: there is no such choice" in done.complaint) == (2, True)


def test_other_errors_keep_their_first_line() -> None:
    assert one_line(ConfigError("the first\nthe second"), "train") == "the first"
    assert one_line(ConfigError(), "train") == "ConfigError"
    assert one_line(ValueError("the first\nthe second"), "train") == "ValueError: the first"
    assert one_line(HydraException("broken\n  in two"), "train") == "broken in two"
    refused = ConnectionRefusedError(errno.ECONNREFUSED, "refused")  # of no file
    assert one_line(refused, "train") == f"ConnectionRefusedError: {refused}"


def test_a_setting_of_a_group_that_is_not_chosen_names_its_choices() -> None:
    text = "Could not override 'task.time_limit'."
    assert hydra_complaint(text, "evaluate") == (
        "task.time_limit: task is not chosen, so it has no settings; give task= too: balance, swingup"
    )
    assert "no such setting" in hydra_complaint("Could not override 'task.time_limt'.", "train")


def test_a_setting_of_a_group_without_a_choice_is_named_in_full() -> None:
    error = HydraException("Could not override 'task.time_limit'.")
    error.__cause__ = ConfigKeyError("full_key: task")
    error.__cause__.full_key = "task"
    assert error_message(error, "evaluate", ()).startswith("task.time_limit: task is not chosen")


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("experment", "did you mean experiment?"),
        ("optimizer.lr", "optimizer has kind, learning_rate, learning_rate_end, max_grad_norm, weight_decay"),
        ("learning.foo", "--cfg job shows the settings"),  # too many to list
    ],
)
def test_an_unknown_setting_is_told_what_there_is(key: str, hint: str) -> None:
    text = f"Could not override '{key}'."
    assert hydra_complaint(text, "train") == f"{key}: there is no such setting; {hint}"


@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_a_setting_of_each_group_without_a_choice_gets_one_line(command: str) -> None:
    groups = [group for group, default in default_choices(command).items() if default is None]
    assert groups
    for group in groups:
        complaint = hydra_complaint(f"Could not override '{group}.seed'.", command)
        expected = "no such setting" if group in WHOLE else "so it has no settings; give"
        assert expected in complaint
        assert "\n" not in complaint


@pytest.mark.parametrize(
    ("command", "key", "complaint"),
    [
        ("evaluate", "plant.port", "plant.port belongs to plant=driver, serial or text: give one of them"),
        ("evaluate", "plant.baud", "plant.baud belongs to plant=driver, serial or text: give one of them"),
        ("finetune", "learner.address", "learner.address belongs to learner=ray: give learner=ray"),
        ("train", "pole.lengths", "pole.lengths belongs to pole=range: give pole=range"),
        ("preflight", "port", "port: there is no such setting; did you mean plant.port?"),
        ("preflight", "plant.rehomes", "plant.rehomes: there is no such setting; did you mean plant.rehome?"),
        (
            "train",
            "randomization.cart_mass.relative",
            "randomization.cart_mass.relative belongs to randomization=dc, half, wide or wider: "
            "give one of them",
        ),
    ],
)
def test_a_setting_of_another_choice_names_that_choice(
    command: str, key: str, complaint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [f"cartpole-{command}", f"{key}=1"])
    assert hydra_complaint(f"Could not override '{key}'.", command) == complaint


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["seed=1", "--seed=1"], "--seed=1: settings are given without dashes: seed=1"),
        (["--seed", "1"], "--seed: settings are given without dashes: seed=1"),
        (["--learning.carts", "4"], "--learning.carts: settings are given without dashes: learning.carts=4"),
        (["--run", "lqr"], "--run: settings are given without dashes: run=lqr"),
        ([], None),
        (["--compile"], "--compile: settings are given without dashes: compile=..."),
        (["--config-dir=mine", "--cfg", "job"], None),
        (["--config-dir", "mine", "--help"], None),
        (["--multirun", "--info", "all", "--hydra-help", "--resolve"], None),
        (["-m", "-sc", "install=bash"], None),
        (["--cfg", "job", "-p", "agent"], None),
        (["-p", "/dev/ttyUSB0"], "-p: a port is given as plant=serial plant.port=/dev/ttyUSB0"),
        (["--port=COM3"], "--port=COM3: a port is given as plant=serial plant.port=/dev/ttyUSB0"),
        (["seed=1", "--hlep"], "--hlep: did you mean --help?"),
        (["--verison"], "--verison: did you mean --version?"),
        (["--cfg"], "--cfg: give --cfg job"),
        (["-c", "seed=1"], "-c: give -c job"),
        (["--cfg", "job", "--help"], None),
        (["--multi-run"], "--multi-run: did you mean --multirun?"),
        (["--mult", "--config-dir=mine"], None),
        (["--resume=first", "--hlep"], "--resume=first: settings are given without dashes: resume=first"),
    ],
)
def test_a_word_with_dashes_that_is_no_option_is_found(words: list[str], message: str | None) -> None:
    assert wrong_option(words) == message


@pytest.mark.parametrize("command", ["train", "finetune"])
def test_no_setting_is_taken_for_an_option(command: str) -> None:
    settings = {setting.partition(".")[0] for setting in known_settings(command, [])}
    assert len(settings) > 5
    for setting in settings:
        assert wrong_option([f"--{setting}", "1"]) == (
            f"--{setting}: settings are given without dashes: {setting}=1"
        )


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("train", "-m --info", "Only one of --run, --multirun, --cfg, --info and --shell_completion can be"),
        ("find_port", "--resolve", "The --resolve flag can only be used in conjunction with --cfg or --help"),
        (
            "finetune",
            "port=COM3",
            "port: there is no such setting; plant.port belongs to plant=driver, serial or text: give one",
        ),
        ("train", "port=COM3", "port: there is no such setting; "),
        ("preflight", "port=COM3", "port: there is no such setting; did you mean plant.port?"),
    ],
)
def test_options_that_exclude_each_other_and_ports_get_one_line(
    command: str, words: str, message: str, tmp_path: Path
) -> None:
    done = in_process(command, *words.split(), folder=tmp_path)
    assert done.complaint.startswith(f"cartpole-{command.replace('_', '-')}: {message}")
    assert "plant=serial" not in done.complaint or command != "train"
    assert done.code == 2
