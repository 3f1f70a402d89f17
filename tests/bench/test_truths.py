"""The drawn carts: inside the ranges of training or beyond them, and always possible."""

import numpy as np
import pytest
import truths as script
from truths import COMPARED, REPORTED, Truth, draw_truths, simulated_cart

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.randomization.ranges import Range

CARTS = 200


def drawn(truth: Truth) -> dict[str, float]:
    """Return the drawn numbers of a truth with the names of the simulator's parameters."""
    names = {name.removesuffix("_left").replace("coulomb_right", "coulomb_asymmetry") for name in truth}
    return {name: value for name, value in simulated_cart(truth).items() if name in names}


def trained_on() -> dict[str, tuple[float, float]]:
    """Return the range of each parameter in randomization=wide, with the nominal cart and pole."""
    nominal = {**choice("cart/ip02"), **choice("pole/medium")["choices"]["medium"]}
    bounds = {}
    for name, line in choice("randomization/wide").items():
        each = Range(**line)
        low, high = each.absolute or (
            [nominal[name] * factor for factor in each.factor]
            if each.factor
            else [nominal[name] * (1 + share) for share in each.relative]
        )
        bounds[name] = (low, high)
    return bounds


def outside(truths: list[Truth]) -> list[set[str]]:
    """Return the parameters of each cart that lie outside the ranges of training."""
    bounds = trained_on()
    return [
        {
            name
            for name, value in drawn(truth).items()
            if name in bounds and not bounds[name][0] <= value <= bounds[name][1]
        }
        for truth in truths
    ]


def test_carts_lie_inside_the_ranges_of_training() -> None:
    truths = draw_truths(REPORTED, CARTS)
    assert set(drawn(truths[0])) - set(trained_on()) == {"cart_stiction_ratio"}
    assert outside(truths) == [set()] * CARTS


def test_wider_carts_lie_outside_those_ranges_and_inside_the_wider_ones() -> None:
    truths = draw_truths(REPORTED, CARTS, 1 / 3)
    beyond = outside(truths)
    assert np.mean([bool(names) for names in beyond]) > 0.9
    assert set.union(*beyond) == set(trained_on()) & set(drawn(truths[0]))
    for name, (low, high) in {**script.UNIFORM, "cart_coulomb_asymmetry": script.COULOMB_ASYMMETRY}.items():
        values = [drawn(truth)[name] for truth in truths]
        lowest, highest = low - (high - low) / 3, high + (high - low) / 3
        assert min(values) >= max(lowest, script.SMALLEST.get(name, lowest)) - 1e-12
        assert highest - 0.05 * (high - low) < max(values) <= highest + 1e-12
    for name, (low, high) in script.LOG_UNIFORM.items():
        values, factor = [drawn(truth)[name] for truth in truths], (high / low) ** (1 / 3)
        assert low / factor <= min(values) < low < high < max(values) <= high * factor


@pytest.mark.parametrize("wider", [0, 0.333, 1])
def test_every_cart_is_possible(wider: float) -> None:
    for truth in draw_truths(3, CARTS, wider):
        cart = EmulatorSettings(**truth)  # has bounds of its own
        assert cart.cart_stiction_ratio >= 1
        assert min(cart.cart_mass, cart.cart_viscous, cart.pole_viscous) > 0
        assert min(cart.cart_coulomb_left, cart.cart_coulomb_right) > 0
        assert min(cart.latency, cart.motor_time_constant) >= 0


def test_a_seed_gives_the_same_carts_and_another_seed_others() -> None:
    reported = draw_truths(REPORTED, 20)
    assert reported == draw_truths(REPORTED, 20)
    assert reported[:5] == draw_truths(REPORTED, 5)
    compared = draw_truths(COMPARED, 20)
    assert all(truth not in compared for truth in reported)
    assert compared[0]["cart_mass"] == pytest.approx(0.7415, abs=1e-3)  # the carts of the first reports


def test_identification_carts_are_possible_and_always_the_same() -> None:
    drawn = script.identification_truths(5)
    assert drawn == script.identification_truths(20)[:5]
    assert len({EmulatorSettings(**truth).cart_mass for truth in drawn}) == 5
