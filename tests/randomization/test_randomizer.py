"""Drawn carts: inside their bounds, distributed as said, poles whole; what cannot be drawn is refused."""

import math
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import (
    POLE_DENSITY,
    Pole,
    PoleSettings,
    check_one_pole,
    possible_poles,
    uniform_rod,
)
from cartpole_rl.randomization.randomizer import POLE_FIELDS, Randomizer
from cartpole_rl.randomization.ranges import DISTRIBUTIONS, Range

COUNT = 20_000
POINT = Pole(pole_mass=0.1, pole_com=0.3, pole_inertia=0.0)
TENTH = {"relative": (-0.1, 0.1)}


@DISTRIBUTIONS.register("squared")  # more carts near the low bound
def squared(share: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return low + share**2 * (high - low)


@DISTRIBUTIONS.register("half")
def half(share: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return low + share / 2 * (high - low)


def draw(randomizer: Randomizer, seed: int = 0, count: int = COUNT) -> CartParameters:
    return CartParameters(randomizer.draw(count, torch.Generator().manual_seed(seed)))


def farthest_from_uniform(values: Tensor) -> float:
    """Kolmogorov-Smirnov distance between the values and the uniform distribution on [0, 1]."""
    return (values.double().sort().values - torch.linspace(0, 1, len(values)).double()).abs().max().item()


@pytest.mark.parametrize(
    ("distribution", "warp"), [("uniform", float), ("log_uniform", math.log), ("squared", None)]
)
@pytest.mark.parametrize(
    ("bounds", "limits"),
    [
        ({"absolute": (0.25, 0.9)}, (0.25, 0.9)),
        ({"relative": (-0.2, 0.3)}, (0.4, 0.65)),
        ({"factor": (0.3, 4.8)}, (0.15, 2.4)),
    ],
)
def test_draws_are_within_bounds_and_distributed_as_specified(
    ip02: dict[str, float], medium: PoleSettings, bounds: dict, limits: Any, distribution: str, warp: Any
) -> None:
    assert ip02["cart_coulomb"] == 0.5
    line = Range(distribution=distribution, **bounds)
    values = draw(Randomizer(ip02, medium, {"cart_coulomb": line})).cart_coulomb.double()
    assert values.min() > limits[0] - 1e-6
    assert values.max() < limits[1] + 1e-6
    if distribution == "log_uniform":
        values, limits = values.log(), [math.log(each) for each in limits]
    share = (values - limits[0]) / (limits[1] - limits[0])
    assert farthest_from_uniform(share.clamp(0, 1).sqrt() if distribution == "squared" else share) < 0.015


def test_parameters_without_a_range_are_nominal_or_have_their_default(
    ip02: dict[str, float], medium: PoleSettings
) -> None:
    given = {name: value for name, value in ip02.items() if name != "force_asymmetry"}
    carts = draw(Randomizer(given, medium, {"cart_mass": Range(relative=(-0.2, 0.2))}), count=10)
    for name, value in {**ip02, **medium.nominal.model_dump()}.items():
        if name != "cart_mass":
            torch.testing.assert_close(getattr(carts, name), torch.full((10,), float(value)))


def test_lines_are_independent_and_the_generator_decides(
    ip02: dict[str, float], medium: PoleSettings
) -> None:
    lines = {
        "cart_mass": Range(relative=(-0.2, 0.2)),
        "cart_viscous": Range(distribution="log_uniform", factor=(0.5, 2)),
        "pole_mass": Range(**TENTH),
    }
    randomizer = Randomizer(ip02, medium, lines)
    values = torch.stack([getattr(draw(randomizer), name) for name in lines])
    assert (torch.corrcoef(values) - torch.eye(3)).abs().max() < 0.03
    assert (draw(randomizer, 1).table == draw(randomizer, 1).table).all()
    assert (draw(randomizer, 1).cart_mass != draw(randomizer, 2).cart_mass).any()


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ({}, "exactly one of absolute, relative, factor"),
        ({"absolute": (0, 1), "factor": (0, 1)}, "exactly one of absolute, relative, factor"),
        ({"relative": (0.2, -0.2)}, "wrong order"),
        (
            {"absolute": (0, 1), "distribution": "normal"},
            "'uniform', 'log_uniform'.* your own as module:name",
        ),
        ({"absolute": (0, 1), "spread": 2}, "spread"),
        ({"absolute": (0, math.inf)}, "finite"),
    ],
)
def test_senseless_lines_are_refused(line: dict, reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        Range(**line)


NEEDS_NOMINAL = "relative and factor bounds need a nominal value"


@pytest.mark.parametrize(
    ("cart", "poles", "name", "line", "reason"),
    [
        ({}, {}, "cart_mas", {"factor": (0.9, 1.1)}, "'cart_mas'; did you mean 'cart_mass'"),
        ({"latenzy": 0.0}, {}, "", {}, "'latenzy'; did you mean 'latency'"),
        ({"cart_mass": -1.0}, {}, "", {}, "cart_mass is -1; it must be above 0"),
        *(({name: 0.2}, {}, "", {}, f"{name} belongs to the pole") for name in POLE_FIELDS),  # no effect
        ({}, {}, "cart_mass", {"absolute": (-0.1, 0.5)}, "cart_mass reaches -0.1; it must be above 0"),
        ({}, {}, "cart_mass", {"relative": (-1.2, 0.2)}, "cart_mass reaches -0.1406; it must be above 0"),
        ({}, {}, "cart_mass", {"factor": (0.0, 2.0)}, "cart_mass reaches 0; it must be above 0"),
        (
            {},
            {},
            "deadband_left",
            {"absolute": (0, 300)},
            "reaches 300; it must be at least 0 and at most 255",
        ),
        ({}, {}, "track_tilt", TENTH, f"track_tilt: {NEEDS_NOMINAL}"),
        ({}, {}, "latency_jitter", {"factor": (0.5, 2.0)}, f"latency_jitter: {NEEDS_NOMINAL}"),
        ({}, {"point": POINT}, "pole_inertia", TENTH, f"pole_inertia: {NEEDS_NOMINAL}"),  # for one pole
        (
            {},
            {},
            "pole_viscous",
            {"absolute": (0.0, 0.1), "distribution": "log_uniform"},
            "pole_viscous: log_uniform needs bounds above 0",
        ),
        ({}, {}, "latency", {"absolute": (0, 0.1), "distribution": "half"}, "half does not run from the low"),
    ],
)
def test_carts_that_cannot_be_drawn_are_refused(
    ip02: dict[str, float], medium: PoleSettings, cart: dict, poles: dict, name: str, line: dict, reason: str
) -> None:
    choices = PoleSettings(choices={**(medium.choices or {}), **poles})
    with pytest.raises(ConfigError, match=reason):
        Randomizer({**ip02, **cart}, choices, {name: Range(**line)} if name else {})


class TestPoles:
    def test_a_choice_sets_mass_centre_and_inertia_together(
        self, ip02: dict[str, float], both_poles: PoleSettings
    ) -> None:
        carts = draw(Randomizer(ip02, both_poles, {}))
        drawn = torch.stack([getattr(carts, name) for name in POLE_FIELDS], 1)
        shares = [
            torch.isclose(drawn, torch.tensor(list(pole.model_dump().values()))).all(1).double().mean().item()
            for pole in possible_poles(both_poles)
        ]
        assert shares == pytest.approx([0.5, 0.5], abs=0.02)
        assert sum(shares) == 1

    def test_a_length_gives_a_consistent_rod(self, ip02: dict[str, float]) -> None:
        carts = draw(Randomizer(ip02, PoleSettings(lengths=(0.2, 1.0)), {}))
        length = carts.pole_length
        assert length.min() >= 0.2
        assert length.max() < 1.0
        assert farthest_from_uniform((length - 0.2) / 0.8) < 0.015
        torch.testing.assert_close(carts.pole_mass, POLE_DENSITY * length)
        torch.testing.assert_close(carts.pivot_inertia, carts.pole_mass * length**2 / 3)
        assert Pole.rod(0.6) == Pole(**uniform_rod(0.6))

    def test_scaling_is_about_the_pole_that_was_drawn(
        self, ip02: dict[str, float], both_poles: PoleSettings
    ) -> None:
        carts = draw(Randomizer(ip02, both_poles, {"pole_mass": Range(**TENTH)}))
        large = carts.pole_com > 0.25
        for rows, nominal in ((~large, 0.127), (large, 0.23)):
            ratio = carts.pole_mass[rows] / nominal
            assert ratio.min() > 0.9 - 1e-6
            assert ratio.max() < 1.1 + 1e-6
            assert ratio.std() > 0.04

    def test_what_represents_a_choice(self, medium: PoleSettings, both_poles: PoleSettings) -> None:
        """The first pole or the middle length is nominal; every choice, or five rods, stand for all."""
        rods = PoleSettings(lengths=(0.2, 1.0))
        assert both_poles.nominal.pole_mass == 0.127
        assert 2 * rods.nominal.pole_com == pytest.approx(0.6)
        assert (both_poles.name, rods.name) == ("medium or large", "0.2 to 1 m")
        assert possible_poles(both_poles) == [*(both_poles.choices or {}).values()]
        assert possible_poles(rods) == [rods.nominal]
        assert both_poles.each == PoleSettings(choices=both_poles.choices, in_turn=True)
        five = rods.each.choices or {}
        assert [2 * pole.pole_com for pole in five.values()] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
        assert list(five) == ["0.20 m", "0.40 m", "0.60 m", "0.80 m", "1.00 m"]
        assert check_one_pole("an identification", medium) == medium.nominal
        with pytest.raises(ConfigError, match="an identification takes one pole, not"):
            check_one_pole("an identification", both_poles)

    def test_poles_in_turn_repeat_cyclically(self, ip02: dict[str, float]) -> None:
        poles = PoleSettings(choices={"short": Pole.rod(0.3), "long": Pole.rod(0.8)}, in_turn=True)
        lengths = draw(Randomizer(ip02, poles, {}), count=5).pole_length
        assert lengths.tolist() == pytest.approx([0.3, 0.8, 0.3, 0.8, 0.3])

    @pytest.mark.parametrize(
        "settings",
        [
            {},
            {"choices": {}},
            {"lengths": (0.5, 0.5)},
            {"lengths": (0.0, 0.5)},
            {"lengths": (0.2, 1.0), "choices": {"a": POINT}},
            {"choices": {"a": {"pole_mass": -1, "pole_com": 1, "pole_inertia": 0}}},
        ],
    )
    def test_senseless_choices_are_refused(self, settings: dict) -> None:
        with pytest.raises(ValidationError):
            PoleSettings(**settings)


def test_what_needs_simulating(ip02: dict[str, float], medium: PoleSettings) -> None:
    def longest(**ranges: Range) -> float:
        return Randomizer({**ip02, "latency_jitter": 0.002}, medium, ranges).longest_delay()

    assert longest() == pytest.approx(0.007)
    assert longest(latency=Range(absolute=(0.0, 0.03))) == pytest.approx(0.032)
    assert longest(latency=Range(relative=(-0.5, 0.5))) == pytest.approx(0.0095)
    assert longest(latency_jitter=Range(factor=(1, 3))) == pytest.approx(0.011)
    randomizer = Randomizer(ip02, medium, {"angle_noise": Range(absolute=(0.0, 0.01))})
    assert randomizer.can_differ_from_zero("angle_noise")
    assert randomizer.can_differ_from_zero("cart_mass")
    assert not randomizer.can_differ_from_zero("position_noise")
