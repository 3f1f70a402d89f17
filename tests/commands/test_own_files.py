"""A user's own files and mappings: the commands and the Python API find them, and read the same from them."""

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import ONCE, TINY, in_process
from every_command import COMMANDS, GROUPS, REQUIRED, SCHEMAS, contents, required, run, value_at
from hydra.core.override_parser.overrides_parser import OverridesParser

from cartpole_rl.checking import validated
from cartpole_rl.choices import default_choices, group_choices
from cartpole_rl.composition import compose, hydra_overrides
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings
from cartpole_rl.terminal import as_word
from cartpole_rl.workflows.config import TrainConfig, load_settings

TENTH = {"cart_mass": {"relative": [-0.1, 0.1]}}
REWARD = {"kind": "score", "scale": 0.1, "track_penalty": 0, "position_cost": 0}
HEAVY = "defaults: [ip02]\ncart_mass: 1.4\n"
KINDS = {  # of files that are right: name, and what is done with the text
    "named like a shipped choice": ("{shipped}.yaml", str.encode),
    "with a byte order mark": ("mine.yaml", lambda text: text.encode("utf-8-sig")),
    "of Windows": ("mine.yaml", lambda text: text.replace("\n", "\r\n").encode()),
    "with odd characters": ("a b,c#d=e[f](g){h}é'.yaml", str.encode),
    "named like a value": ("true.yaml", str.encode),
    "in an odd folder": ("a b,c=#é/mine.yaml", str.encode),
    "with a short suffix": ("mine.yml", str.encode),
}
UNREAD = {  # by their default plant, or but for policies of one's own
    "evaluate": {"emulator", "observation"},
    "record": {"emulator", "observation"},
    "preflight": {"emulator"},
}


def numbers(tree: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], float]]:
    """The positive floats in a tree."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from numbers(value, (*path, name))
        elif isinstance(value, float) and value > 0:
            yield (*path, name), value


def own_choice(command: str, group: str) -> tuple[str, dict[str, Any], tuple[str, ...], float | None]:
    """A shipped choice of a group, changes of it for a file, and which number is then found where."""
    default = default_choices(command)[group] or next(iter(group_choices(group)))
    if group == "experiment":
        return default, {"seed": 7}, ("seed",), 7
    if group == "emulator":
        return default, {"cart_viscous": 0.77}, (group, "cart_viscous"), 0.77
    found = next(numbers(group_choices(group)[default]), None)
    if found is None:
        return default, {}, (), None
    path, value = found
    changed: Any = round(0.99 * value, 12)
    number = changed
    for name in reversed(path):
        changed = {name: changed}
    return default, changed, (group, *path), number


def own_choices(command: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Each group of a command, a shipped choice of it, and changes."""
    for other, group in GROUPS:
        if other == command and group not in UNREAD.get(command, ()):
            default, changes, *_ = own_choice(command, group)
            yield group, default, changes


def found_numbers(config: Settings, command: str) -> dict[tuple[str, ...], tuple[float, Any]]:
    """The number that the file of each group gives, and the one that is composed."""
    cases = (own_choice(command, group)[2:] for group, *_ in own_choices(command))
    return {path: (number, value_at(config, path)) for path, number in cases if number is not None}


@pytest.mark.parametrize("command", COMMANDS)
def test_files_of_all_groups_are_found_from_everywhere(command: str, tmp_path: Path) -> None:
    """Here, where one file extends another, by a whole path, in --config-dir, in a sweep, and from Python."""
    words: dict[str, list[str]] = {"here": [], "whole": [], "folder": ["--config-dir=own"]}
    by_name: dict[str, Any] = {**REQUIRED.get(command, {})}
    for group, default, changes in own_choices(command):
        text = yaml.safe_dump({"defaults": [default], **changes})
        (tmp_path / f"{group}.yaml").write_text(text)
        (tmp_path / f"{group}_extended.yaml").write_text(f"defaults: [{group}.yaml]\n")
        file = tmp_path / "own" / group / "mine.yaml"
        file.parent.mkdir(parents=True)
        file.write_text(f"# @package _global_\n{text}" if group == "experiment" else text)
        words["here"].append(f"{group}={group}_extended.yaml")
        words["whole"].append(f"{group}={tmp_path}/{group}.yaml")
        words["folder"].append(f"{group}=mine")
        by_name[group] = tmp_path / f"{group}.yaml"
    before = contents(tmp_path)
    expected = validated(SCHEMAS[command], compose(command, by_name))
    assert all(given == number for given, number in found_numbers(expected, command).values())
    all_ways = command == "train"  # the others have some of its groups
    for where in words if all_ways else [[*words][len(command) % len(words)]]:
        done, config = run(command, *required(command), *words[where], folder=tmp_path)
        assert (done.code, done.err) == (0, ""), (where, done)
        assert config == expected, where
    assert contents(tmp_path) == before
    if not all_ways:
        return
    group, *_ = next(own_choices(command))
    both = f"{group}={group}.yaml,{group}_extended.yaml"
    found: list[Settings] = []
    swept = (*required(command), *words["here"][1:], "-m", both)
    done = in_process(command, *swept, folder=tmp_path, function=lambda config: found.append(config))
    assert (done.code, found) == (0, [expected, expected]), done


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_may_have_any_name(kind: str, tmp_path: Path) -> None:
    name, encoded = KINDS[kind]
    words = []
    for group, default, changes in own_choices("train"):  # which reads most groups
        file = tmp_path / group / name.replace("{shipped}", default)
        file.parent.mkdir(parents=True)
        file.write_bytes(encoded(yaml.safe_dump({"defaults": [default], **changes})))
        words.append(f"{group}={file}")
    done, config = run("train", *words, folder=tmp_path)
    assert (done.code, done.err) == (0, ""), done
    assert config is not None
    assert all(given == number for given, number in found_numbers(config, "train").values())


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


def test_files_of_config_dir(tmp_path: Path) -> None:
    (tmp_path / "own/cart").mkdir(parents=True)
    (tmp_path / "own/cart/lab.yaml").write_text(HEAVY)
    assert shown(tmp_path, "--config-dir", "own", "cart=lab")["cart"]["cart_mass"] == 1.4
    (tmp_path / "own/experiment").mkdir()
    (tmp_path / "own/experiment/trial.yaml").write_text(
        "# @package _global_\ndefaults: [override /cart: lab]\nagent: {gamma: 0.95}\n"
    )
    settings = shown(tmp_path, "--config-dir=own", "experiment=trial")
    assert (settings["cart"]["cart_mass"], settings["agent"]["gamma"]) == (1.4, 0.95)
    with hydra_overrides("emulate", [f"--config-dir={tmp_path}/own", "emulator.cart=lab"]) as (words, _):
        assert f'emulator.cart="{tmp_path}/own/cart/lab.yaml"' in words
    (tmp_path / "own/cart/ip02.yaml").write_text(HEAVY)
    complaint = refused(tmp_path, "--config-dir", "own", "cart=ip02")
    assert complaint == "--config-dir=own: cart/ip02.yaml has the name of a shipped choice; rename it"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--config-dir", "/nonexistent", "cart=ip02"), "--config-dir=/nonexistent: not found"),
        (
            ("hydra.searchpath=[file:///nonexistent]", "seed=x"),
            "hydra.searchpath: /nonexistent not found; give a folder",
        ),
        (("seed=true",), "seed=true: give an integer"),
        (("agent.gamma=false",), "agent.gamma=false: give a number"),
        (("actions.motors=[true,false]",), "actions.motors.0=true: give an integer"),
        (("cart.cart_mass=1e308",), "cart.cart_mass=1e+308, which is over 1e+30: give a number"),
    ],
)
def test_folders_that_are_not_there_and_what_is_no_number(
    words: tuple[str, ...], complaint: str, tmp_path: Path
) -> None:
    assert refused(tmp_path, *words).startswith(complaint)


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
    if text == "no":
        assert refused(tmp_path, "cart=mine.yaml") == f"mine.yaml: cart.cart_viscous={text}: give a number"
    with pytest.raises(ConfigError, match=f"cart.cart_viscous={text}: give a number"):
        load_settings(TrainConfig, {"cart": tmp_path / "mine.yaml"})


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


def test_a_file_of_a_group_that_a_command_does_not_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("defaults: [ip02]\n")
    done = in_process("finetune", "run=pretrained/medium", "cart=mine.yaml", folder=tmp_path)
    assert done.complaint == "cartpole-finetune: cart: cartpole-finetune does not read this group"


def test_the_file_of_a_pole_is_no_cart(tmp_path: Path) -> None:
    (tmp_path / "my_pole.yaml").write_text(
        "choices: {mine: {pole_mass: 0.1, pole_com: 0.2, pole_inertia: 1e-3}}\n"
    )
    told = "cart=my_pole.yaml: it is the file of a pole; give it as pole=my_pole.yaml"
    assert refused(tmp_path, "cart=my_pole.yaml") == told


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
def test_a_printed_word_survives_the_shell_and_hydra(value: str) -> None:
    (word,) = shlex.split(as_word("run", value))
    override = OverridesParser.create().parse_override(word)
    assert (override.is_sweep_override(), override.value()) == (False, value)


@pytest.mark.usefixtures("without_pictures")
def test_a_printed_command_with_a_label_of_two_words_runs(tmp_path: Path) -> None:
    done = in_process("train", *TINY, ONCE, "label=two words", folder=tmp_path)
    command, *words = shlex.split(done.out.splitlines()[-1])
    done = in_process(command.removeprefix("cartpole-"), *words[:1], "episodes=1", folder=tmp_path)
    assert done.code == 0, done
