"""The carts of the zero-shot bench: inside the ranges of training or beyond them, and always possible."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.randomization.ranges import Range

SCRIPT = Path(__file__).parents[2] / "scripts/bench/zero_shot.py"
CARTS = 200


@pytest.fixture(scope="module")
def zero_shot() -> ModuleType:
    spec = importlib.util.spec_from_file_location("zero_shot_script", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def simulated(truth: dict[str, float]) -> dict[str, float]:
    """A truth in the simulator's words."""
    left, right = truth["cart_coulomb_left"], truth["cart_coulomb_right"]
    others = {name: value for name, value in truth.items() if not name.startswith("cart_coulomb")}
    return {
        **others,
        "cart_coulomb": (left + right) / 2,
        "cart_coulomb_asymmetry": (right - left) / (right + left),
    }


def trained_on() -> dict[str, tuple[float, float]]:
    """Lowest and highest value of each number of randomization=wide, about the nominal cart and pole."""
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


def outside(truths: list[dict[str, float]]) -> list[set[str]]:
    """The numbers of each cart that no training meets."""
    bounds = trained_on()
    return [
        {
            name
            for name, value in simulated(truth).items()
            if name in bounds and not bounds[name][0] <= value <= bounds[name][1]
        }
        for truth in truths
    ]


def test_carts_lie_inside_the_ranges_of_training(zero_shot: ModuleType) -> None:
    truths = zero_shot.draw_truths(zero_shot.REPORTED, CARTS)
    assert set(simulated(truths[0])) - set(trained_on()) == {"cart_stiction_ratio"}
    assert outside(truths) == [set()] * CARTS


def test_wider_carts_lie_outside_of_them_and_inside_the_wider_ranges(zero_shot: ModuleType) -> None:
    truths = zero_shot.draw_truths(zero_shot.REPORTED, CARTS, 1 / 3)
    beyond = outside(truths)
    assert np.mean([bool(names) for names in beyond]) > 0.9
    assert set.union(*beyond) == set(trained_on()) & set(simulated(truths[0]))
    for name, (low, high) in {**zero_shot.UNIFORM, "cart_coulomb_asymmetry": zero_shot.SIDES}.items():
        values = [simulated(truth)[name] for truth in truths]
        lowest, highest = low - (high - low) / 3, high + (high - low) / 3
        assert min(values) >= max(lowest, zero_shot.SMALLEST.get(name, lowest)) - 1e-12
        assert highest - 0.05 * (high - low) < max(values) <= highest + 1e-12
    for name, (low, high) in zero_shot.LOG_UNIFORM.items():
        values, factor = [simulated(truth)[name] for truth in truths], (high / low) ** (1 / 3)
        assert low / factor <= min(values) < low < high < max(values) <= high * factor


@pytest.mark.parametrize("wider", [0, 0.333, 1])
def test_every_cart_is_possible(zero_shot: ModuleType, wider: float) -> None:
    for truth in zero_shot.draw_truths(3, CARTS, wider):
        cart = EmulatorSettings(**truth)  # has bounds of its own
        assert cart.cart_stiction_ratio >= 1
        assert min(cart.cart_mass, cart.cart_viscous, cart.pole_viscous) > 0
        assert min(cart.cart_coulomb_left, cart.cart_coulomb_right) > 0
        assert min(cart.latency, cart.motor_time_constant) >= 0


def test_a_seed_has_its_carts(zero_shot: ModuleType) -> None:
    reported = zero_shot.draw_truths(zero_shot.REPORTED, 20)
    assert reported == zero_shot.draw_truths(zero_shot.REPORTED, 20)
    assert reported[:5] == zero_shot.draw_truths(zero_shot.REPORTED, 5)
    compared = zero_shot.draw_truths(zero_shot.COMPARED, 20)
    assert all(truth not in compared for truth in reported)
    assert compared[0]["cart_mass"] == pytest.approx(0.7415, abs=1e-3)  # the carts of the first reports


def test_reports_are_not_of_the_carts_that_settings_were_compared_on(
    zero_shot: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["zero_shot.py", "runs/train/a"])
    assert zero_shot.arguments().seed == zero_shot.REPORTED != zero_shot.COMPARED
    monkeypatch.setattr(sys, "argv", ["zero_shot.py", "runs/train/a", "--wider", "1.5"])
    with pytest.raises(SystemExit):
        zero_shot.arguments()


def test_a_cart_that_cannot_be_driven_is_counted_apart(zero_shot: ModuleType) -> None:
    figures = zero_shot.cart_figures({}, np.array([4000.0, np.nan, 100.0]), 4000.0)
    assert figures["scores"] == [4000.0, None, 100.0]
    assert (figures["mean_ratio"], figures["worst_ratio"]) == pytest.approx((0.5125, 0.025))
    assert (figures["lost"], figures["not_driven"]) == (1, 1)
    assert zero_shot.cart_figures({}, np.array([np.nan]), 4000.0)["mean_ratio"] is None
