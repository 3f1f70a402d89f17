"""Drawn carts: inside their bounds, distributed as said, poles whole."""

import math

import pytest
import torch
from pydantic import ValidationError
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import POLE_DENSITY, Pole, PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.ranges import Range

COUNT = 20_000
POLE_FIELDS = ("pole_mass", "pole_com", "pole_inertia")


def draw(randomizer: Randomizer, seed: int = 0, count: int = COUNT) -> CartParameters:
    return CartParameters.from_table(randomizer.draw(count, torch.Generator().manual_seed(seed)))


def farthest_from_uniform(values: Tensor) -> float:
    """Kolmogorov-Smirnov distance between the values and the uniform distribution on [0, 1]."""
    return (values.double().sort().values - torch.linspace(0, 1, len(values)).double()).abs().max().item()


@pytest.mark.parametrize("distribution", ["uniform", "log_uniform"])
@pytest.mark.parametrize(
    ("kind", "bounds", "limits"),
    [
        ("absolute", (0.25, 0.9), (0.25, 0.9)),
        ("relative", (-0.2, 0.3), (0.4, 0.65)),
        ("factor", (0.3, 4.8), (0.15, 2.4)),
    ],
)
def test_draws_are_within_bounds_and_distributed_as_specified(
    ip02: dict[str, float],
    medium: PoleSettings,
    kind: str,
    bounds: tuple[float, float],
    limits: tuple[float, float],
    distribution: str,
) -> None:
    assert ip02["cart_coulomb"] == 0.5
    line = Range(distribution=distribution, **{kind: bounds})
    values = draw(Randomizer(ip02, medium, {"cart_coulomb": line})).cart_coulomb.double()
    low, high = limits
    assert values.min() > low - 1e-6
    assert values.max() < high + 1e-6
    if distribution == "log_uniform":
        values, low, high = values.log(), math.log(low), math.log(high)
    assert farthest_from_uniform((values - low) / (high - low)) < 0.015


def test_parameters_without_a_range_are_nominal(ip02: dict[str, float], medium: PoleSettings) -> None:
    carts = draw(Randomizer(ip02, medium, {"cart_mass": Range(relative=(-0.2, 0.2))}), count=10)
    for name, value in {**ip02, **medium.nominal.model_dump()}.items():
        if name != "cart_mass":
            torch.testing.assert_close(getattr(carts, name), torch.full((10,), float(value)))


def test_lines_are_independent(ip02: dict[str, float], medium: PoleSettings) -> None:
    lines = {name: Range(relative=(-0.2, 0.2)) for name in ("cart_mass", "cart_viscous", "pole_mass")}
    carts = draw(Randomizer(ip02, medium, lines))
    values = torch.stack([getattr(carts, name) for name in lines])
    correlation = torch.corrcoef(values) - torch.eye(3)
    assert correlation.abs().max() < 0.03


def test_the_generator_decides(ip02: dict[str, float], medium: PoleSettings) -> None:
    randomizer = Randomizer(ip02, medium, {"latency": Range(absolute=(0.0, 0.02))})
    assert (draw(randomizer, 1).latency == draw(randomizer, 1).latency).all()
    assert (draw(randomizer, 1).latency != draw(randomizer, 2).latency).any()


class TestRefusals:
    def test_an_unknown_name(self, ip02: dict[str, float], medium: PoleSettings) -> None:
        with pytest.raises(ConfigError, match="'cart_mas'; did you mean 'cart_mass'"):
            Randomizer(ip02, medium, {"cart_mas": Range(factor=(0.9, 1.1))})

    def test_an_unknown_nominal_name(self, ip02: dict[str, float], medium: PoleSettings) -> None:
        with pytest.raises(ConfigError, match="'latenzy'; did you mean 'latency'"):
            Randomizer({**ip02, "latenzy": 0.0}, medium, {})

    def test_a_negative_mass(self, ip02: dict[str, float], medium: PoleSettings) -> None:
        with pytest.raises(ConfigError, match="cart_mass is -1; it must be above 0"):
            Randomizer({**ip02, "cart_mass": -1.0}, medium, {})

    def test_a_range_that_is_impossible_about_the_nominal_value(
        self, ip02: dict[str, float], medium: PoleSettings
    ) -> None:
        with pytest.raises(
            ConfigError, match="angle_offset: relative and factor bounds need a nominal value"
        ):
            Randomizer(ip02, medium, {"angle_offset": Range(factor=(0.9, 1.1))})

    @pytest.mark.parametrize("name", POLE_FIELDS)
    def test_a_number_of_the_poles_among_the_carts(
        self, ip02: dict[str, float], medium: PoleSettings, name: str
    ) -> None:
        """It would have no effect: the chosen pole sets it."""
        with pytest.raises(ConfigError, match=f"{name} belongs to the pole"):
            Randomizer({**ip02, name: 0.2}, medium, {})

    def test_a_range_that_is_impossible_for_one_of_the_poles(
        self, ip02: dict[str, float], medium: PoleSettings
    ) -> None:
        assert medium.choices is not None
        point = Pole(pole_mass=0.1, pole_com=0.3, pole_inertia=0.0)
        poles = PoleSettings(choices={**medium.choices, "point": point})
        with pytest.raises(
            ConfigError, match="pole_inertia: relative and factor bounds need a nominal value"
        ):
            Randomizer(ip02, poles, {"pole_inertia": Range(relative=(-0.1, 0.1))})


class TestPoles:
    def test_a_choice_sets_mass_centre_and_inertia_together(
        self, ip02: dict[str, float], both_poles: PoleSettings
    ) -> None:
        carts = draw(Randomizer(ip02, both_poles, {}))
        drawn = torch.stack([getattr(carts, name) for name in POLE_FIELDS], 1)
        assert both_poles.choices is not None
        shares = []
        for pole in both_poles.choices.values():
            is_this = torch.isclose(drawn, torch.tensor(list(pole.model_dump().values()))).all(1)
            shares.append(is_this.double().mean().item())
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

    def test_scaling_is_about_the_pole_that_was_drawn(
        self, ip02: dict[str, float], both_poles: PoleSettings
    ) -> None:
        carts = draw(Randomizer(ip02, both_poles, {"pole_mass": Range(relative=(-0.1, 0.1))}))
        large = carts.pole_com > 0.25
        for rows, nominal in ((~large, 0.127), (large, 0.23)):
            ratio = carts.pole_mass[rows] / nominal
            assert ratio.min() > 0.9 - 1e-6
            assert ratio.max() < 1.1 + 1e-6
            assert ratio.std() > 0.04

    def test_the_first_choice_or_the_middle_length_is_nominal(self, both_poles: PoleSettings) -> None:
        assert both_poles.nominal.pole_mass == 0.127
        assert 2 * PoleSettings(lengths=(0.2, 1.0)).nominal.pole_com == pytest.approx(0.6)

    def test_names(self, both_poles: PoleSettings) -> None:
        assert both_poles.name == "medium or large"
        assert PoleSettings(lengths=(0.2, 1.0)).name == "0.2 to 1 m"

    @pytest.mark.parametrize(
        "settings",
        [
            {},
            {"choices": {}},
            {"lengths": (0.5, 0.5)},
            {"lengths": (0.0, 0.5)},
            {"lengths": (0.2, 1.0), "choices": {"a": {"pole_mass": 1, "pole_com": 1, "pole_inertia": 0}}},
            {"choices": {"a": {"pole_mass": -1, "pole_com": 1, "pole_inertia": 0}}},
        ],
    )
    def test_senseless_choices_are_refused(self, settings: dict) -> None:
        with pytest.raises(ValidationError):
            PoleSettings(**settings)


class TestWhatNeedsSimulating:
    def test_longest_delay(self, ip02: dict[str, float], medium: PoleSettings) -> None:
        def longest(**ranges: Range) -> float:
            return Randomizer({**ip02, "latency_jitter": 0.002}, medium, ranges).longest_delay()

        assert longest() == pytest.approx(0.007)
        assert longest(latency=Range(absolute=(0.0, 0.03))) == pytest.approx(0.032)
        assert longest(latency=Range(relative=(-0.5, 0.5))) == pytest.approx(0.0095)
        assert longest(latency_jitter=Range(factor=(1, 3))) == pytest.approx(0.011)

    def test_what_can_differ_from_zero(self, ip02: dict[str, float], medium: PoleSettings) -> None:
        randomizer = Randomizer(ip02, medium, {"angle_noise": Range(absolute=(0.0, 0.01))})
        assert randomizer.can_differ_from_zero("angle_noise")
        assert randomizer.can_differ_from_zero("cart_mass")
        assert not randomizer.can_differ_from_zero("position_noise")
