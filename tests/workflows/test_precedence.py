"""One rule decides which number is driven, and a run prints the numbers that are not nominal.

Nominal value < a choice's default < a person's file < the command line, for every group.
"""

from itertools import permutations
from pathlib import Path
from typing import Any

import pytest
import yaml

from cartpole_rl.checking import validated
from cartpole_rl.choices import choice, default_choices, group_choices
from cartpole_rl.composition import compose
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import parameters_of
from cartpole_rl.workflows.build import evaluated_agent, own_training, replaced_settings
from cartpole_rl.workflows.checks import check_identification, check_training, note_other_numbers
from cartpole_rl.workflows.config import EvaluateConfig, IdentifyConfig, TrainConfig, load_settings

IP02 = choice("cart/ip02")
VISCOUS = "cart_viscous"
FRICTIONS = ("cart_friction", "pole_friction")
GIVEN = {  # group: a number of it that a person gives in a file, and then on the command line
    "cart": ("cart_mass", 0.8, 0.9),
    "task": ("time_limit", 400, 300),
    "pole": ("choices.mine.pole_mass", 0.2, 0.3),
    "actions": ("motors", [-200, 0, 200], [-100, 0, 100]),
    "cart_friction": ("parameters.cart_coulomb", 0.7, 0.8),
    "pole_friction": ("parameters.pole_viscous", 1e-3, 2e-3),
    "reward": ("scale", 0.5, 0.25),
    "randomization": ("cart_mass.relative", [-0.1, 0.1], [-0.3, 0.3]),
    "observation": ("past_motors", 5, 6),
    "guard": ("quantile", 0.9, 0.8),
    "agent": ("gamma", 0.9, 0.8),
    "buffer": ("size", 60_000, 70_000),
    "optimizer": ("learning_rate", 1e-4, 2e-4),
    "learning": ("transitions", 500_000, 600_000),
    "plant": ("substeps", 6, 8),
}


def nested(name: str, value: Any) -> dict[str, Any]:
    first, _, rest = name.partition(".")
    return {first: nested(rest, value) if rest else value}


def value_of(tree: dict[str, Any], name: str) -> Any:
    for part in name.split("."):
        tree = tree[part]
    return tree


def has(tree: dict[str, Any], name: str) -> bool:
    first, _, rest = name.partition(".")
    return first in tree and (not rest or (isinstance(tree[first], dict) and has(tree[first], rest)))


def trained(*words: str) -> TrainConfig:
    """The settings of cartpole-train with these words, as the command composes them."""
    return validated(TrainConfig, compose("train", words))


def written(folder: Path, group: str, content: dict[str, Any]) -> str:
    """The word that chooses a file with this content."""
    (folder / f"{group}_mine.yaml").write_text(yaml.safe_dump(content))
    return f"{group}={folder}/{group}_mine.yaml"


def test_the_table_names_every_group_of_a_training() -> None:
    with_settings = {group for group, name in default_choices("train").items() if name is not None}
    assert GIVEN.keys() == with_settings


@pytest.mark.parametrize("group", GIVEN)
def test_a_file_replaces_a_choice_and_the_command_line_both(group: str, tmp_path: Path) -> None:
    name, in_file, typed = GIVEN[group]
    default = default_choices("train")[group]
    content = nested(name, in_file)
    if group == "pole":
        content = {"choices": {"mine": {"pole_mass": in_file, "pole_com": 0.2, "pole_inertia": 1e-3}}}
    elif group in FRICTIONS:
        content = {"model": default, **content}
    else:
        content = {"defaults": [default], **content}
    file = written(tmp_path, group, content)
    others = ["agent.mirrored=true"] if group == "actions" else []
    chosen = trained(file, *others).model_dump(mode="json")
    assert value_of(chosen[group], name) == in_file
    word = f"{group}.{name}={typed}".replace(" ", "")
    overridden = trained(file, *others, word)
    assert value_of(overridden.model_dump(mode="json")[group], name) == typed
    if group in ("cart", *FRICTIONS):
        assert overridden.nominal_cart[name.rpartition(".")[2]] == typed


CARTS = {  # words, and the viscous friction that is driven
    "nominal": ([], 0.5),
    "choice": (["cart_friction=linear"], 1.75),
    "choice of a cart": (["cart=thesis"], 0.0),
    "two choices": (["cart=thesis", "cart_friction=linear"], 1.75),
    "experiment": (["experiment=friction_models_fig_6_8"], 0.0),
    "experiment and choice": (["experiment=friction_models_fig_6_8", "cart_friction=linear"], 1.75),
    "file": (["cart"], 55.7),
    "experiment, file and choice": (["experiment=thesis_swingup", "cart", "cart_friction=linear"], 55.7),
    "command line": (["cart", "cart_friction=linear", "cart.cart_viscous=3"], 3.0),
    "command line, with the friction": (
        ["cart", "cart_friction=linear", "cart_friction.parameters.cart_viscous=4"],
        4.0,
    ),
    "file of a friction": (["cart", "cart_friction"], 6.0),
    "file that leaves it out": (["cart_of_other_mass", "cart_friction=linear"], 1.75),
}


@pytest.mark.parametrize("case", CARTS)
def test_the_cart_that_is_driven(case: str, tmp_path: Path) -> None:
    words, viscous = CARTS[case]
    files = {
        "cart": written(tmp_path, "cart", {**IP02, VISCOUS: 55.7, "latency": 0.03}),
        "cart_friction": written(
            tmp_path, "cart_friction", {"model": "linear", "parameters": {VISCOUS: 6.0}}
        ),
    }
    (tmp_path / "other").mkdir()
    files["cart_of_other_mass"] = written(
        tmp_path / "other", "cart", {"defaults": ["ip02"], "cart_mass": 0.9}
    )
    config = trained(*(files.get(word, word) for word in words))
    assert config.nominal_cart[VISCOUS] == viscous
    if "cart" in words:
        assert config.nominal_cart["latency"] == 0.03


@pytest.mark.parametrize(
    ("form", "value"), [("typed", 0.5), ("file", 55.7), ("file", 0.5), ("whole file", 55.7), ("mapping", 0.5)]
)
def test_a_number_is_kept_beside_a_friction_that_has_its_own(form: str, value: float, tmp_path: Path) -> None:
    """Before and after it, wherever the number stands, and equal to the nominal value too."""
    whole = {**IP02, VISCOUS: value}
    if form == "mapping":
        names = {"cart": whole, "cart_friction": "linear"}
        orders = [
            validated(TrainConfig, compose("train", dict(each))) for each in permutations(names.items())
        ]
    else:
        content = whole if form == "whole file" else {"defaults": ["ip02"], VISCOUS: value}
        given = f"cart.{VISCOUS}={value}" if form == "typed" else written(tmp_path, "cart", content)
        orders = [trained(*words) for words in permutations((given, "cart_friction=linear"))]
    assert [config.nominal_cart[VISCOUS] for config in orders] == [value, value]


@pytest.mark.parametrize("group", [group for group in GIVEN if group not in FRICTIONS])
def test_the_order_of_words_changes_nothing(group: str) -> None:
    """A number that is typed beside a choice is kept, even if it equals that of the default choice."""
    name = "choices.medium.pole_mass" if group == "pole" else GIVEN[group][0]
    default = choice(f"{group}/{default_choices('train')[group]}")
    choices = [each for each in group_choices(group) if has(choice(f"{group}/{each}"), name)]
    others = [each for each in choices if each != default_choices("train")[group] and group != "plant"]
    chosen = (others or ["simulated" if group == "plant" else choices[0]])[0]
    value = value_of(default, name) if has(default, name) else GIVEN[group][2]
    words = [f"{group}={chosen}", f"{group}.{name}={value}".replace(" ", "")]
    found = [compose("train", order)[group] for order in (words, words[::-1])]
    assert {str(value_of(each, name)) for each in found} == {str(value)}


@pytest.mark.parametrize(
    ("words", "at_0_02_s"),
    [
        ((), (0.99, 0.0, 1, 500)),
        (("agent.horizon=0.5", "agent.action_time=0.1"), (0.96, 0.8, 1, 500)),
        (("learning=mine.yaml", "task=swingup", "task.duration=4"), (0.99, 0.0, 10, 200)),
        (("agent.horizon=0.5", "agent.gamma=0.9"), (0.9, 0.0, 1, 500)),
        (("agent.horizon=null",), (0.99, 0.0, 1, 500)),
        (("++agent.horizon=Null", "~agent.action_time"), (0.99, 0.0, 1, 500)),
    ],
)
def test_seconds_that_a_person_gives_replace_control_periods(
    words: tuple[str, ...], at_0_02_s: tuple[float, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The experiment has gamma, action_gap and n_step."""
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text("defaults: [fast]\nreturn_time: 0.2\n")
    config = trained("experiment=thesis_swingup", *words)
    agent, learning, task = (each.at(0.02) for each in (config.agent, config.learning, config.task))
    assert (agent.gamma, agent.action_gap, learning.n_step, task.time_limit) == at_0_02_s


@pytest.mark.parametrize(("group", "model"), [("cart_friction", "linear"), ("pole_friction", "bearing")])
def test_an_evaluation_keeps_a_cart_that_a_person_gave(group: str, model: str) -> None:
    """In the training or in the evaluation, whatever friction model either chooses."""
    given = {**parameters_of(IP02), VISCOUS: 55.7, "pole_viscous": 0.01}
    for first, second in (({"cart": given}, {group: model}), ({group: model}, {"cart": given})):
        training = load_settings(TrainConfig, first)
        config = load_settings(EvaluateConfig, {"run": "somewhere", **second})
        settings = replaced_settings(training, config)
        assert (settings.nominal_cart, getattr(settings, group).model) == (given, model)


def test_numbers_that_are_not_nominal_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    for words, line in (
        ([], ""),
        (["cart_friction=step", "pole=both"], ""),
        (["cart_friction=linear"], "cart_viscous 1.75 instead of 0.5"),
        (
            ["cart.cart_mass=0.8", "pole=large", "pole.choices.large.pole_mass=0.25"],
            "cart_mass 0.8 instead of 0.703, pole_mass 0.25 instead of 0.23",
        ),
    ):
        config = trained(*words)
        note_other_numbers("train", config.nominal_cart, (config.pole.choices or {}).values())
        head = "cartpole-train: note: no cart in conf/ has these numbers: "
        assert capsys.readouterr().err == (f"{head}{line}\n" if line else "")


@pytest.mark.parametrize("task", [{}, {"task": "swingup"}])
def test_an_evaluation_with_a_cart_ends_at_its_track(task: dict[str, str]) -> None:
    """Also the baseline's, whose settings are those of a training of ip02."""
    config = load_settings(EvaluateConfig, {"run": "lqr", "cart": "sensorsini", "pole": "sensorsini", **task})
    training = own_training(config, ("cart",), {})
    assert replaced_settings(training, config).task.x_max == choice("cart/sensorsini")["track_half_length"]


def test_a_track_that_was_chosen_for_a_training_stays() -> None:
    training = load_settings(TrainConfig, {"task.x_max": 0.25})
    evaluation = load_settings(EvaluateConfig, {"run": "somewhere", "cart": "ip02"})
    assert replaced_settings(training, evaluation).task.x_max == 0.25
    longer = load_settings(TrainConfig, {"cart.track_half_length": 0.5})  # of a run from before the check
    assert replaced_settings(longer, evaluation.model_copy(update={"cart": None})).task.x_max == 0.5


def test_an_exported_agent_is_checked_against_the_cart_that_it_drives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driven: list[Any] = []
    monkeypatch.setattr(
        "cartpole_rl.workflows.build.OwnPolicy", lambda run, motors, given: driven.append(given)
    )
    evaluated_agent(load_settings(EvaluateConfig, {"run": "agent.onnx", "cart": "sensorsini"}))
    track = choice("cart/sensorsini")["track_span"]
    assert (driven[0]["hardware"]["track_span"], driven[0]["control_period"]) == (track, 0.02)


@pytest.mark.parametrize(
    ("cart", "message"),
    [
        (
            {"track_span": 0.5},
            r"track_half_length is 0\.38 m, but the stops are 0\.25 m .* 0\.223 m",
        ),
        ({"cart_mass": 350}, "cart_mass is 350; it must be above 0 and at most 100"),
    ],
)
def test_a_cart_in_other_units_is_refused(cart: dict[str, float], message: str) -> None:
    given = {f"cart.{name}": each for name, each in cart.items()}
    with pytest.raises(ConfigError, match=message):
        check_training(load_settings(TrainConfig, given), Path(), [])
    with pytest.raises(ConfigError, match=message):
        check_identification(load_settings(IdentifyConfig, given))
