"""Labels name the settings that differ, those that a person chose first."""

from typing import Any

from cartpole_rl.choices import choice
from cartpole_rl.reporting.grouping import ALL, SOURCE, fewest, labels, setting_columns
from cartpole_rl.workflows.config import TrainConfig, load_settings


def columns(*trees: dict[str, Any]) -> dict[str, list[str]]:
    return setting_columns(trees)


def test_settings_that_differ_are_named() -> None:
    found = columns({"agent": {"gamma": 0.99, "tau": 1}}, {"agent": {"gamma": 0.9, "tau": 1}})
    assert found == {"agent.gamma": ["0.99", "0.9"]}
    assert labels(found, 2) == ["gamma=0.99", "gamma=0.9"]
    assert labels({}, 2) == [ALL, ALL]


def test_numbers_have_the_digits_that_tell_them_apart() -> None:
    near = 0.33333331, 0.33333334
    assert columns(*({"share": value} for value in near)) == {"share": [str(value) for value in near]}


def test_a_choice_of_conf_is_named_by_its_file() -> None:
    trees = [
        {"randomization": choice(f"randomization/{name}") or {}} for name in ("none", "friction_3", "wide")
    ]
    assert columns(*trees) == {"randomization": ["none", "friction_3", "wide"]}


def test_the_choice_of_a_run_folder_is_named_by_its_file() -> None:
    def written(name: str) -> dict[str, Any]:
        given = load_settings(TrainConfig, {"randomization": name}).model_dump(mode="json")
        return {"randomization": given["randomization"]}

    found = columns(*map(written, ("half", "wide")))
    assert found == {"randomization": ["half", "wide"]}
    assert labels(found, 2) == ["half", "wide"]


def test_groups_are_named_in_a_readers_words() -> None:
    agents = [
        {"cart": choice("cart/ip02"), "randomization": choice("randomization/wide")},
        {"cart": {"cart_mass": 0.8}, "randomization": {"cart_mass": {"relative": [-0.01, 0.01]}}},
    ]
    words = {"agent.cart": "identified", "agent.randomization": "identified"}
    trees = [*({"agent": agent} for agent in agents), {SOURCE: "pretrained/medium"}, {SOURCE: "lqr"}]
    found = setting_columns(trees, [{}, words, {}, {}])
    chosen = [SOURCE, "agent.cart", "agent.randomization"]
    assert labels(fewest(found, chosen), 4) == ["wide", "identified", "pretrained/medium", "lqr"]


def test_words_that_stand_for_two_things_are_not_used() -> None:
    trees = [{"cart": {"cart_mass": mass}} for mass in (0.7, 0.8)]
    assert setting_columns(trees, [{"cart": "identified"}] * 2) == {"cart.cart_mass": ["0.7", "0.8"]}


def test_a_choice_with_another_value_is_not_named_by_its_file() -> None:
    changed = choice("cart_friction/step") | {"model": "linear", "parameters": {"cart_coulomb": 0.3}}
    found = columns({"cart_friction": choice("cart_friction/step")}, {"cart_friction": changed})
    assert "cart_friction" not in found


def test_derived_settings_are_left_out_of_labels_and_chosen_ones_stay() -> None:
    trees = [
        {"pole": {"mass": mass, "length": 2 * mass}, "guard": {"numbers": {"margin": mass / 10}}, "lr": lr}
        for mass, lr in ((1, 5), (1, 6), (2, 5), (2, 6))
    ]
    found = columns(*trees)
    assert set(fewest(found, [])) == {"pole.mass", "lr"}
    assert [*fewest(found, ["pole.length"])] == ["pole.length", "lr"]


def test_what_was_given_of_an_emulated_cart_is_named_last() -> None:
    trees = [
        {"emulator": {"given": ["cart_viscous"], "cart_viscous": 2.0}},
        {"emulator": {"given": [], "cart_viscous": 0.65}},
    ]
    assert labels(fewest(columns(*trees), []), 2) == ["cart_viscous=2", "cart_viscous=0.65"]
