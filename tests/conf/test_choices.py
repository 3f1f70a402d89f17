"""Every choice of every group composes, is read to the last key, and describes a cart that can be made."""

from functools import cache
from itertools import chain, zip_longest
from typing import Any

import pytest
import yaml
from every_command import leaves
from hydra.core.override_parser.overrides_parser import OverridesParser

from cartpole_rl.checking import validated
from cartpole_rl.choices import conf_folder, default_choices, load
from cartpole_rl.composition import compose
from cartpole_rl.envs.build import randomizer
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import hardware_of
from cartpole_rl.workflows.build import evaluated_settings
from cartpole_rl.workflows.config import EvaluateConfig, FinetuneConfig, TrainConfig

CONF = conf_folder()
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
NOT_OF_TRAINING = ("emulator", "plant", "finetuning", "layout", "learner", "sweep")  # or not all choices
REPLACEABLE = ("task", "pole", "cart_friction", "pole_friction", "reward", "randomization")


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def side_by_side(*groups: str) -> list[list[str]]:
    """Words that choose the first of each group, the second of each, and so on to the last of the longest."""
    named = ([f"{group}={choice}" for choice in choices(group)] for group in groups)
    return [[word for word in words if word] for words in zip_longest(*named)]


EXPERIMENTS = choices("experiment")
ALONE = ("experiment", "agent", "cart")  # groups whose choices do not go with all others
OTHERS = [group for group in GROUPS if group not in (*NOT_OF_TRAINING, *ALONE)]
NEEDED = {"agent=recurrent": ["observation=positions"]}  # beside a choice


@cache
def composed(name: str, *overrides: str) -> dict[str, Any]:
    return compose(name, overrides)


@pytest.fixture(scope="module")
def trained() -> TrainConfig:
    """Without a guard, whose numbers an evaluation would fit anew."""
    return validated(TrainConfig, composed("train", "guard=none"))


@pytest.mark.parametrize(
    "chosen", [*side_by_side(*OTHERS), *(words for group in ALONE for words in side_by_side(group))], ids=str
)
def test_training_takes_it(chosen: list[str]) -> None:
    config = validated(TrainConfig, composed("train", *chosen, *NEEDED.get(chosen[0], [])))
    draws = randomizer(config)
    assert float(draws.nominal.abs().sum()) > 0
    assert config.models(config.plant).integrator


@pytest.mark.parametrize("chosen", [*side_by_side(*REPLACEABLE), *side_by_side("cart")], ids=str)
def test_an_evaluation_can_replace_the_agents_choice(chosen: list[str], trained: TrainConfig) -> None:
    config = validated(EvaluateConfig, composed("evaluate", "run=somewhere", *chosen))
    if config.cart is not None and hardware_of(config.cart) != trained.hardware:
        with pytest.raises(ConfigError, match="train one for this cart"):
            evaluated_settings(trained, config)
        return
    settings = evaluated_settings(trained, config)
    randomizer(settings)
    wanted = validated(TrainConfig, composed("train", *chosen))
    for group in {word.partition("=")[0] for word in chosen} - {"cart_friction", "pole_friction"}:
        assert getattr(settings, group) == getattr(wanted, group)  # numbers of friction are then the cart's
    assert settings.nominal_cart == wanted.nominal_cart


@pytest.mark.parametrize("chosen", choices("finetuning"))
def test_fine_tuning_takes_it(chosen: str) -> None:
    words = ("run=somewhere", f"finetuning={chosen}")
    assert validated(FinetuneConfig, composed("finetune", *words)).finetuning.iterations > 0


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_holds_only_differences(experiment: str) -> None:
    """From the experiment that it extends, or the defaults of cartpole-train.

    Those of the thesis name every group, each with its source.
    """
    content = yaml.safe_load((CONF / f"experiment/{experiment}.yaml").read_text()) or {}
    lines = content.pop("defaults", [])
    extended = [line for line in lines if isinstance(line, str)]
    groups = dict(next(iter(line.items())) for line in lines if isinstance(line, dict))
    chosen = {name.removeprefix("override /"): choice for name, choice in groups.items()}
    if not experiment.startswith("thesis"):
        others = default_choices("train") | dict(load("experiment", extended).groups)
        assert not [group for group in chosen if load(group, chosen[group]) == load(group, others[group])]
    words = (f"experiment={line}" for line in extended), (f"{group}={name}" for group, name in chosen.items())
    before = dict(leaves(composed("train", *chain(*words))))
    assert not [name for name, value in leaves(content) if name in before and before[name] == value]


@pytest.mark.parametrize("sweep", choices("sweep"))
def test_training_takes_every_value_of_a_sweep(sweep: str) -> None:
    params = yaml.safe_load((CONF / f"sweep/{sweep}.yaml").read_text())["hydra"]["sweeper"]["params"]
    for parsed in OverridesParser.create().parse_overrides(
        [f"{key}={value}" for key, value in params.items()]
    ):
        interval = parsed.value() if parsed.is_interval_sweep() else None
        values = [interval.start, interval.end] if interval else [*parsed.sweep_string_iterator()]
        assert len({*values}) > 1
        group, _, name = parsed.get_key_element().partition(".")
        for value in values if group in GROUPS and not name else (values[0], values[-1]):  # of numbers
            config = validated(TrainConfig, composed("train", f"{parsed.get_key_element()}={value}"))
            if name:
                assert getattr(getattr(config, group), name) == float(value)


def test_every_file_starts_with_a_description() -> None:
    for path in CONF.rglob("*.yaml"):
        assert path.read_text().lstrip().startswith("#"), path
