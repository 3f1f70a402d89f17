"""Labels name the settings that differ, those that a person chose first."""

from typing import Any

from cartpole_rl.choices import choice
from cartpole_rl.reporting.grouping import ALL, fewest, labels, setting_columns


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
