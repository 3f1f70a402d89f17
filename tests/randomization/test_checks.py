"""Carts, poles and ranges of which no cart could be drawn are refused."""

import pytest

from cartpole_rl.errors import ConfigError
from cartpole_rl.randomization.checks import check_carts, check_one_pole, possible_poles
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.ranges import Range


def uniform(**bounds: tuple[float, float]) -> Range:
    return Range(distribution="uniform", **bounds)


def test_a_possible_cart_passes(ip02: dict[str, float], both_poles: PoleSettings) -> None:
    check_carts(ip02, both_poles, {"cart_mass": uniform(relative=(-0.2, 0.2))})


def test_a_number_of_the_pole_is_not_the_carts(ip02: dict[str, float], medium: PoleSettings) -> None:
    with pytest.raises(ConfigError, match="pole_mass belongs to the pole"):
        check_carts({**ip02, "pole_mass": 0.1}, medium, {})


def test_an_impossible_nominal_value_is_refused(ip02: dict[str, float], medium: PoleSettings) -> None:
    with pytest.raises(ConfigError, match="cart_mass"):
        check_carts({**ip02, "cart_mass": -1.0}, medium, {})


def test_a_range_of_an_unknown_name_is_refused(ip02: dict[str, float], medium: PoleSettings) -> None:
    with pytest.raises(ConfigError, match="cart_mas"):
        check_carts(ip02, medium, {"cart_mas": uniform(factor=(0.9, 1.1))})


def test_a_range_is_checked_with_each_pole(ip02: dict[str, float], medium: PoleSettings) -> None:
    """A relative range needs a nominal value other than 0; the second pole has none."""
    point = medium.nominal.model_copy(update={"pole_inertia": 0.0})
    ranges = {"pole_inertia": uniform(relative=(-0.1, 0.1))}
    check_carts(ip02, medium, ranges)
    with pytest.raises(ConfigError, match="pole_inertia"):
        check_carts(ip02, PoleSettings(choices={"rod": medium.nominal, "point": point}), ranges)


def test_choices_are_the_possible_poles(medium: PoleSettings, both_poles: PoleSettings) -> None:
    assert possible_poles(medium) == [medium.nominal]
    assert possible_poles(both_poles) == list(both_poles.choices.values())
    rods = PoleSettings(lengths=(0.3, 0.7))
    assert possible_poles(rods) == [rods.nominal]


def test_one_pole_is_returned_and_several_are_refused(medium: PoleSettings, both_poles: PoleSettings) -> None:
    assert check_one_pole("an identification", medium) == medium.nominal
    with pytest.raises(ConfigError, match="an identification takes one pole, not"):
        check_one_pole("an identification", both_poles)
