"""A person's own files and mappings: the commands and the Python API read the same from them."""

import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import TINY, in_process
from hydra.core.override_parser.overrides_parser import OverridesParser

from cartpole_rl.errors import ConfigError
from cartpole_rl.terminal import as_value, as_word
from cartpole_rl.workflows.config import TrainConfig, load_settings

TENTH = {"cart_mass": {"relative": [-0.1, 0.1]}}
REWARD = {"kind": "score", "scale": 0.1, "track_penalty": 0, "position_cost": 0}
HEAVY = "defaults: [ip02]\ncart_mass: 1.4\n"


def shown(folder: Path, *words: str) -> dict[str, Any]:
    """The settings that --cfg job shows."""
    done = in_process("train", *words, "--cfg", "job", "--resolve", folder=folder)
    assert (done.code, done.err) == (0, ""), done
    settings: dict[str, Any] = yaml.safe_load(done.out)
    return settings


def refused(folder: Path, *words: str) -> str:
    """The line of a command that refuses its words."""
    done = in_process("train", *words, folder=folder)
    assert done.code == 2, done
    assert not (folder / "runs").exists()
    return done.complaint.removeprefix("cartpole-train: ")


@pytest.mark.parametrize("path", ["ip02.yaml", "./ip02.yaml", "{folder}/ip02.yaml"])
def test_a_file_named_like_a_shipped_choice_is_read(path: str, tmp_path: Path) -> None:
    (tmp_path / "ip02.yaml").write_text(HEAVY)
    assert shown(tmp_path, f"cart={path.format(folder=tmp_path)}")["cart"]["cart_mass"] == 1.4
    assert load_settings(TrainConfig, {"cart": tmp_path / "ip02.yaml"}).cart["cart_mass"] == 1.4


def test_a_sweep_reads_a_file_named_like_a_shipped_choice_too(tmp_path: Path) -> None:
    (tmp_path / "ip02.yaml").write_text(HEAVY)
    words = ("-m", "cart=ip02,ip02.yaml", "seed=0,1", "--cfg", "job", "-p", "cart.cart_mass")
    done = in_process("train", *words, folder=tmp_path)
    assert (done.code, done.out.split(), done.err) == (0, ["0.703", "0.703", "1.4", "1.4"], "")


def test_files_of_config_dir(tmp_path: Path) -> None:
    (tmp_path / "own/cart").mkdir(parents=True)
    (tmp_path / "own/cart/lab.yaml").write_text(HEAVY)
    assert shown(tmp_path, "--config-dir", "own", "cart=lab")["cart"]["cart_mass"] == 1.4
    (tmp_path / "own/cart/ip02.yaml").write_text(HEAVY)
    complaint = refused(tmp_path, "--config-dir", "own", "cart=ip02")
    assert complaint == "--config-dir=own: cart/ip02.yaml has the name of a shipped choice; rename it"


@pytest.mark.parametrize("words", [("--config-dir", "/nonexistent"), ("--config-dir=/nonexistent",)])
def test_a_config_dir_that_is_not_there(words: tuple[str, ...], tmp_path: Path) -> None:
    complaint = refused(tmp_path, *words, "cart=ip02")
    assert complaint.startswith("--config-dir=/nonexistent: not found")


def test_a_search_path_that_is_not_there(tmp_path: Path) -> None:
    complaint = refused(tmp_path, "hydra.searchpath=[file:///nonexistent]", "seed=x")
    assert complaint == "hydra.searchpath: /nonexistent not found; give a folder"


def test_a_file_extends_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/heavy.yaml").write_text(HEAVY)
    (tmp_path / "deep/own.yaml").write_text("defaults: [heavy.yaml]\ncart_viscous: 0.9\n")
    (tmp_path / "deep/trial.yaml").write_text("defaults: [large, {override /cart: own.yaml}]\nseed: 5\n")
    for words in ({"cart": "deep/own.yaml"}, {"experiment": "deep/trial.yaml"}):
        settings = shown(tmp_path, *(f"{name}={path}" for name, path in words.items()))
        assert (settings["cart"]["cart_mass"], settings["cart"]["cart_viscous"]) == (1.4, 0.9)
        config = load_settings(TrainConfig, {name: tmp_path / path for name, path in words.items()})
        assert config.cart == settings["cart"]
        assert config.seed == settings["seed"]


@pytest.mark.parametrize("text", ["no", "yes", "1:30", "on"])
def test_a_number_is_a_number(text: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(f"defaults: [ip02]\ncart_viscous: {text}\n")
    assert refused(tmp_path, "cart=mine.yaml") == f"mine.yaml: cart.cart_viscous={text}: give a number"
    with pytest.raises(ConfigError, match=f"cart.cart_viscous={text}: give a number"):
        load_settings(TrainConfig, {"cart": tmp_path / "mine.yaml"})


@pytest.mark.parametrize(
    ("word", "complaint"),
    [
        ("seed=true", "seed=true: give an integer"),
        ("agent.gamma=false", "agent.gamma=false: give a number"),
        ("actions.motors=[true,false]", "actions.motors.0=true: give an integer"),
        ("cart.cart_mass=1e308", "cart.cart_mass=1e+308, which is over 1e+30: give a number"),
        ("randomization.cart_mass.relative=[0,1e308]", "randomization.cart_mass.relative.1=1e+308, which"),
    ],
)
def test_what_is_no_number(word: str, complaint: str, tmp_path: Path) -> None:
    assert refused(tmp_path, word).startswith(complaint)


def test_a_persons_file_outlasts_an_experiment(tmp_path: Path) -> None:
    """What a person gave is never replaced by a choice of the package; the command line comes last."""
    (tmp_path / "mine.yaml").write_text("defaults: [simulated]\nsubsteps: 3\n")
    words = ("experiment=integrators_section_3_1_3", "plant=mine.yaml")
    settings = shown(tmp_path, *words)
    assert settings["plant"]["substeps"] == 3
    assert settings["plant"]["integrator"] == "explicit"  # of the experiment: the file does not give it
    config = load_settings(
        TrainConfig, {"experiment": "integrators_section_3_1_3", "plant": tmp_path / "mine.yaml"}
    )
    assert config.plant.model_dump(mode="json").items() >= settings["plant"].items()
    assert shown(tmp_path, *words, "plant.substeps=2")["plant"]["substeps"] == 2


@pytest.mark.parametrize(
    ("word", "name", "value"),
    [
        ("randomization={cart_mass:{relative:[-0.1,0.1]}}", "randomization", TENTH),
        ("pole=[medium,large]", "pole", ["medium", "large"]),
        ("~randomization.cart_mass", "~randomization.cart_mass", None),
        ("+randomization.cart_mass={relative:[0,0.2]}", "+randomization.cart_mass", {"relative": [0, 0.2]}),
        ("cart.cart_mass=${cart.cart_viscous}", "cart.cart_mass", "${cart.cart_viscous}"),
        ("reward={kind:score,scale:0.1,track_penalty:0,position_cost:0}", "reward", REWARD),
    ],
)
def test_python_takes_what_the_command_line_takes(word: str, name: str, value: Any, tmp_path: Path) -> None:
    group = name.partition(".")[0].lstrip("~+")
    expected = load_settings(TrainConfig, {name: value}).model_dump(mode="json")[group]
    settings = load_settings(TrainConfig, {group: shown(tmp_path, word)[group]})
    assert settings.model_dump(mode="json")[group] == expected


def test_interpolation_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("defaults: [ip02]\ncart_mass: ${cart.cart_viscous}\n")
    config = load_settings(TrainConfig, {"cart": tmp_path / "mine.yaml"})
    assert config.cart["cart_mass"] == config.cart["cart_viscous"]
    assert shown(tmp_path, "cart=mine.yaml")["cart"] == config.cart
    (tmp_path / "mine.yaml").write_text("defaults: [ip02]\ncart_mass: ${cart.mass}\n")
    with pytest.raises(ConfigError, match=r"cart\.mass"):
        load_settings(TrainConfig, {"cart": tmp_path / "mine.yaml"})
    assert "cart.mass" in refused(tmp_path, "cart=mine.yaml")


@pytest.mark.parametrize(
    "value", ["a b", "a'b", 'a"b', "a,b", "a=b", "[a]", "{a}", "a#b", "a\\", "a$b", "é", "a:b", "a;b"]
)
@pytest.mark.parametrize("written", [as_word, lambda name, value: f"{name}={as_value(value)}"])
def test_a_printed_word_survives_the_shell_and_hydra(written: Callable[[str, str], str], value: str) -> None:
    (word,) = shlex.split(written("run", value))
    override = OverridesParser.create().parse_override(word)
    assert (override.is_sweep_override(), override.value()) == (False, value)


def test_a_printed_command_with_a_label_of_two_words_runs(tmp_path: Path) -> None:
    done = in_process("train", *TINY, "label=two words", folder=tmp_path)
    command, *words = shlex.split(done.out.splitlines()[-1])
    done = in_process(command.removeprefix("cartpole-"), *words[:1], "episodes=1", folder=tmp_path)
    assert done.code == 0, done
    odd = os.fsdecode(os.fsencode(tmp_path / "runs/train/odd") + b"\xff")
    next((tmp_path / "runs/train").iterdir()).rename(odd)
    assert in_process("train", *TINY, "seed=1", "hydra.run.dir=runs/train/other", folder=tmp_path).code == 0
    done = in_process("report", "runs=runs/train", "animations=false", folder=tmp_path)
    assert (done.code, done.err) == (0, ""), done
    assert "2 runs count, 0 do not" in done.out
