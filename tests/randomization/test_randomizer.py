"""Drawn carts: inside their bounds, distributed as said, poles whole; what cannot be drawn is refused."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from scipy import stats
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.distributions import DISTRIBUTIONS
from cartpole_rl.randomization.poles import (
    POLE_DENSITY,
    Pole,
    PoleSettings,
    check_one_pole,
    possible_poles,
    uniform_rod,
)
from cartpole_rl.randomization.randomizer import POLE_FIELDS, Randomizer
from cartpole_rl.randomization.ranges import Range

COUNT = 20_000
Of = Callable[..., Randomizer]
POINT = Pole(pole_mass=0.1, pole_com=0.3, pole_inertia=0.0)
TENTH = {"relative": (-0.1, 0.1)}
NORMAL = {"absolute": (0, 1), "distribution": "truncated_normal"}


@DISTRIBUTIONS.register("squared")  # more carts near the low bound
def squared(share: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return low + share**2 * (high - low)


@DISTRIBUTIONS.register("beyond")
def beyond(share: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return low + 2 * share * (high - low)


@DISTRIBUTIONS.register("bump")  # beyond its bounds between the shares that a few trials see
def bump(share: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return low + share * (high - low) + 100 * ((share > 0.5) & (share < 0.9))


@DISTRIBUTIONS.register("failing")
def failing(share: Tensor, low: Tensor) -> Tensor:
    return low + share


@DISTRIBUTIONS.register("flat")
def flat(share: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return share[:, :2]


@DISTRIBUTIONS.register("first_column")  # as a user may write it: bounds are [R, 1]
def first_column(share: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return low[:, :1] + share * (high[:, :1] - low[:, :1])


def draw(randomizer: Randomizer, seed: int = 0, count: int = COUNT) -> CartParameters:
    return CartParameters(randomizer.draw(count, torch.Generator().manual_seed(seed)))


@pytest.fixture(scope="module")
def of(ip02: dict[str, float], medium: PoleSettings) -> Callable[..., Randomizer]:
    """Randomizers of the nominal cart with the medium pole, of other `poles` or another `cart`."""
    return lambda lines, poles=medium, **cart: Randomizer({**ip02, **cart}, poles, lines)


def farthest_from_uniform(values: Tensor) -> float:
    """Kolmogorov-Smirnov distance between the values and the uniform distribution on [0, 1]."""
    return (values.double().sort().values - torch.linspace(0, 1, len(values)).double()).abs().max().item()


@pytest.mark.parametrize("distribution", ["uniform", "log_uniform", "squared"])
@pytest.mark.parametrize(
    ("bounds", "limits"),
    [
        ({"absolute": (0.25, 0.9)}, (0.25, 0.9)),
        ({"relative": (-0.2, 0.3)}, (0.4, 0.65)),
        ({"factor": (0.3, 4.8)}, (0.15, 2.4)),
    ],
)
def test_draws_are_within_bounds_and_distributed_as_specified(
    of: Of, bounds: dict, limits: Any, distribution: str
) -> None:
    values = draw(of({"cart_coulomb": Range(distribution=distribution, **bounds)})).cart_coulomb.double()
    assert values.min() > limits[0] - 1e-6
    assert values.max() < limits[1] + 1e-6
    if distribution == "log_uniform":
        values, limits = values.log(), [math.log(each) for each in limits]
    share = (values - limits[0]) / (limits[1] - limits[0])
    assert farthest_from_uniform(share.clamp(0, 1).sqrt() if distribution == "squared" else share) < 0.015


SHAPED: dict[str, tuple[dict[str, Any], Any]] = {  # a line for cart_coulomb, 0.5 N, and SciPy's distribution
    "truncated_normal": ({"absolute": (0.25, 0.9)}, stats.truncnorm(-2, 2, 0.575, 0.1625)),
    "truncated_normal, off the middle": (
        {"relative": (-0.2, 0.3), "mean": 0.1, "std": 0.2},
        stats.truncnorm(-1.5, 1, 0.55, 0.1),
    ),
    "log_normal": ({"factor": (0.25, 4)}, stats.lognorm(math.log(16) / 4, scale=0.5)),
    "log_normal, wide": ({"factor": (0.01, 10), "median": 0.4, "sigma": 0.3}, stats.lognorm(0.3, scale=0.2)),
    "beta": ({"factor": (0.5, 1.5)}, stats.beta(2, 2, 0.25, 0.5)),
    "beta, skewed": ({"absolute": (0, 1), "alpha": 0.5, "beta": 3}, stats.beta(0.5, 3)),
}


@pytest.mark.parametrize("case", SHAPED)
def test_shaped_distributions_are_those_of_scipy(case: str, of: Of) -> None:
    settings, expected = SHAPED[case]
    line = Range(distribution=case.split(",")[0], **settings)
    values = draw(of({"cart_coulomb": line})).cart_coulomb.double()
    low, high = (limit * (0.5 if line.scales_nominal else 1) for limit in line.limits())
    assert low - 1e-6 < values.min()
    assert values.max() < high + 1e-6
    shares = torch.from_numpy(expected.cdf(values.numpy()))
    ends = expected.cdf(low), expected.cdf(high)
    assert farthest_from_uniform((shares - ends[0]) / (ends[1] - ends[0])) < 0.015
    assert Range.model_validate_json(line.model_dump_json()) == line


def test_values_and_lines_have_the_shares_of_their_weights(of: Of, ip02: dict[str, float]) -> None:
    lines = {
        "latency": Range(distribution="discrete", absolute=(0.02, 0.0, 0.01), weights=(1, 2, 5)),
        "cart_mass": Range(distribution="discrete", relative=(-0.1, 0.1, 0.2)),
        "cart_viscous": Range(mixture=({"factor": (0.5, 1)}, {"factor": (2, 3)}), weights=(3, 1)),
    }
    carts = draw(of(lines))
    shares = [(carts.latency == value).float().mean() for value in torch.tensor([0.02, 0.0, 0.01])]
    assert shares == pytest.approx([0.125, 0.25, 0.625], abs=0.02)
    ratios, counts = (carts.cart_mass / ip02["cart_mass"]).unique(return_counts=True)
    assert ratios.tolist() == pytest.approx([0.9, 1.1, 1.2])
    assert (counts / COUNT).tolist() == pytest.approx([1 / 3] * 3, abs=0.02)
    ratio = carts.cart_viscous / ip02["cart_viscous"]
    assert ((ratio > 1.001) & (ratio < 1.999)).sum() == 0
    assert (ratio > 1.5).float().mean() == pytest.approx(0.25, abs=0.02)
    assert farthest_from_uniform(2 * ratio[ratio < 1.5] - 1) < 0.015


def test_lines_are_correlated_as_said(of: Of, ip02: dict[str, float]) -> None:
    """Each keeps its own distribution; the third is independent of both."""
    lines = {
        "cart_mass": Range(**TENTH),
        "cart_viscous": Range(factor=(0.5, 2), distribution="log_uniform", correlation={"cart_mass": -0.8}),
        "pole_mass": Range(**TENTH),
    }
    randomizer = of(lines)
    carts = draw(randomizer)
    shares = torch.stack(
        [
            5 * (carts.cart_mass / ip02["cart_mass"] - 0.9),
            (carts.cart_viscous / ip02["cart_viscous"]).log() / math.log(4) + 0.5,
            5 * (carts.pole_mass / 0.127 - 0.9),
        ]
    ).double()
    assert all(farthest_from_uniform(share) < 0.02 for share in shares)
    scores = torch.special.ndtri(shares.clamp(1e-6, 1 - 1e-6))
    wanted = torch.tensor([[1, -0.8, 0], [-0.8, 1, 0], [0, 0, 1]]).double()
    assert (torch.corrcoef(scores) - wanted).abs().max() < 0.03
    low, high = randomizer.ends("cart_viscous", 100, torch.Generator().manual_seed(0))
    assert (low != high).any(1).tolist() == [name == "cart_viscous" for name in CartParameters.names()]


def test_correlations_that_no_carts_have_are_refused(of: Of) -> None:
    others = {"cart_viscous": 0.9, "pole_mass": 0.9}
    lines = {
        "cart_mass": Range(**TENTH, correlation=others),
        "cart_viscous": Range(**TENTH, correlation={"pole_mass": -0.9}),
        "pole_mass": Range(**TENTH),
    }
    with pytest.raises(ConfigError, match="contradict each other"):
        of(lines)
    with pytest.raises(ConfigError, match="cart_mass: correlation takes other randomized parameters"):
        of({"cart_mass": lines["cart_mass"]})


def test_parameters_without_a_range_are_nominal_or_have_their_default(
    ip02: dict[str, float], medium: PoleSettings
) -> None:
    given = {name: value for name, value in ip02.items() if name != "force_asymmetry"}
    carts = draw(Randomizer(given, medium, {"cart_mass": Range(relative=(-0.2, 0.2))}), count=10)
    for name, value in {**ip02, **medium.nominal.model_dump()}.items():
        if name != "cart_mass":
            torch.testing.assert_close(getattr(carts, name), torch.full((10,), float(value)))


def test_the_generator_decides(of: Of) -> None:
    randomizer = of({"cart_mass": Range(**TENTH)})
    assert (draw(randomizer, 1).table == draw(randomizer, 1).table).all()
    assert (draw(randomizer, 1).cart_mass != draw(randomizer, 2).cart_mass).any()


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ({}, "exactly one of absolute, relative, factor"),
        ({"absolute": (0, 1), "factor": (0, 1)}, "exactly one of absolute, relative, factor"),
        ({"relative": (0.2, -0.2)}, "wrong order"),
        ({"absolute": (0, 1), "distribution": "gauss"}, "'uniform', 'log_uniform'.* your own as module:n"),
        ({"absolute": (0, 1), "spread": 2}, "spread: there is no such setting; uniform takes bounds"),
        ({**NORMAL, "sdt": 2}, "sdt: there is no such setting; truncated_normal takes bounds, mean, std"),
        ({**NORMAL, "std": 0}, "std=0: give more than 0"),
        ({**NORMAL, "std": True}, "std=true: give a number"),
        ({**NORMAL, "mean": 2}, "mean 2 is outside the bounds"),
        ({"absolute": (0, 1, 2)}, r"uniform takes two, \[low, high\]"),
        ({"absolute": (0, 1, 2), "distribution": "discrete", "weights": (1, 2)}, "give 3 weights, not 2"),
        ({"mixture": [TENTH, TENTH], "weights": (1, 2, 3)}, "give 2 weights, not 3"),
        ({"mixture": [TENTH, {"absolute": (0, 1)}]}, "all absolute, or none is"),
        ({"mixture": [TENTH, TENTH], **TENTH}, "in its lines alone"),
        ({"mixture": [TENTH, {**TENTH, "correlation": {"latency": 0.5}}]}, "beside mixture"),
        ({**TENTH, "correlation": {"latency": 2}}, "less than or equal to 1"),
        ({"absolute": (0, math.inf)}, "finite"),
    ],
)
def test_senseless_lines_are_refused(line: dict, reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        Range(**line)


NEEDS_NOMINAL = "relative and factor bounds need a nominal value"


@pytest.mark.parametrize(
    ("name", "line", "reason"),
    [
        ("cart_mas", {"factor": (0.9, 1.1)}, "'cart_mas'; did you mean 'cart_mass'"),
        ("cart_mass", {"absolute": (-0.1, 0.5)}, "cart_mass reaches -0.1; it must be above 0"),
        ("cart_mass", {"relative": (-1.2, 0.2)}, "cart_mass reaches -0.1406; it must be above 0"),
        ("cart_mass", {"factor": (0.0, 2.0)}, "cart_mass reaches 0; it must be above 0"),
        ("deadband_left", {"absolute": (0, 300)}, "reaches 300; it must be at least 0 and at most 255"),
        ("track_tilt", TENTH, f"track_tilt: {NEEDS_NOMINAL}"),
        ("latency_jitter", {"factor": (0.5, 2.0)}, f"latency_jitter: {NEEDS_NOMINAL}"),
        ("pole_inertia", TENTH, f"pole_inertia: {NEEDS_NOMINAL}"),  # for one of two poles
        ("latency", {"absolute": (0, 0.1), "distribution": "log_uniform"}, "needs bounds above 0"),
        ("latency", {"absolute": (0, 0.1), "distribution": "beyond"}, "beyond leaves its bounds"),
        ("cart_mass", {**TENTH, "distribution": "bump"}, "bump leaves its bounds"),
        ("cart_mass", {**TENTH, "distribution": "flat"}, "flat fails: RuntimeError: The expanded size"),
        ("cart_mass", {**TENTH, "distribution": "failing"}, r"failing fails: TypeError: failing\(\) takes"),
    ],
)
def test_lines_that_no_cart_has_are_refused(
    of: Of, medium: PoleSettings, name: str, line: dict, reason: str
) -> None:
    choices = PoleSettings(choices={**(medium.choices or {}), "point": POINT})
    with pytest.raises(ConfigError, match=reason):
        of({name: Range(**line)}, choices)


@pytest.mark.parametrize(
    ("cart", "reason"),
    [
        ({"latenzy": 0.0}, "'latenzy'; did you mean 'latency'"),
        ({"cart_mass": -1.0}, "cart_mass is -1; it must be above 0"),
        *(({name: 0.2}, f"{name} belongs to the pole") for name in POLE_FIELDS),  # no effect
    ],
)
def test_carts_that_cannot_be_drawn_are_refused(of: Of, cart: dict[str, float], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        of({}, **cart)


class TestPoles:
    def test_a_choice_sets_mass_centre_and_inertia_together(self, of: Of, both_poles: PoleSettings) -> None:
        carts = draw(of({}, both_poles))
        drawn = torch.stack([getattr(carts, name) for name in POLE_FIELDS], 1)
        shares = [
            torch.isclose(drawn, torch.tensor(list(pole.model_dump().values()))).all(1).double().mean().item()
            for pole in possible_poles(both_poles)
        ]
        assert shares == pytest.approx([0.5, 0.5], abs=0.02)
        assert sum(shares) == 1

    def test_a_length_gives_a_consistent_rod(self, of: Of) -> None:
        carts = draw(of({}, PoleSettings(lengths=(0.2, 1.0))))
        length = carts.pole_length
        assert length.min() >= 0.2
        assert length.max() < 1.0
        assert farthest_from_uniform((length - 0.2) / 0.8) < 0.015
        torch.testing.assert_close(carts.pole_mass, POLE_DENSITY * length)
        torch.testing.assert_close(carts.pivot_inertia, carts.pole_mass * length**2 / 3)
        assert Pole.rod(0.6) == Pole(**uniform_rod(0.6))

    def test_scaling_is_about_the_pole_that_was_drawn(self, of: Of, both_poles: PoleSettings) -> None:
        carts = draw(of({"pole_mass": Range(**TENTH)}, both_poles))
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

    def test_poles_in_turn_repeat_cyclically(self, of: Of) -> None:
        poles = PoleSettings(choices={"short": Pole.rod(0.3), "long": Pole.rod(0.8)}, in_turn=True)
        lengths = draw(of({}, poles), count=5).pole_length
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


@pytest.mark.parametrize(
    ("lines", "delay"),
    [
        ({}, 0.007),
        ({"latency": Range(absolute=(0.0, 0.03))}, 0.032),
        ({"latency": Range(relative=(-0.5, 0.5))}, 0.0095),
        ({"latency_jitter": Range(factor=(1, 3))}, 0.011),
    ],
)
def test_the_longest_delay(of: Of, lines: dict[str, Range], delay: float) -> None:
    assert of(lines, latency_jitter=0.002).longest_delay() == pytest.approx(delay)


def test_lines_of_a_mixture_have_bounds_as_a_line_alone(of: Of, ip02: dict[str, float]) -> None:
    line = Range(distribution="first_column", relative=(-0.1, 0.1))
    drawn = draw(of({"cart_mass": Range(mixture=(line, line))})).cart_mass / ip02["cart_mass"]
    assert farthest_from_uniform(((drawn - 0.9) / 0.2 * 2).remainder(1)) < 0.015


def test_the_nominal_value_can_be_the_median(of: Of, ip02: dict[str, float]) -> None:
    line = Range(distribution="log_normal", relative=(-0.3, 0.3), median=0.0)
    assert draw(of({"cart_mass": line})).cart_mass.median().item() == pytest.approx(
        ip02["cart_mass"], rel=0.02
    )


def test_a_keyword_without_a_type_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"untyped: give its keyword power a type, as in power: float"):

        @DISTRIBUTIONS.register("untyped")
        def untyped(share: Tensor, low: Tensor, high: Tensor, *, power=2.0) -> Tensor:  # type: ignore[no-untyped-def]
            return low


def test_what_needs_simulating(of: Of) -> None:
    randomizer = of({"angle_noise": Range(absolute=(0.0, 0.01))})
    assert randomizer.can_differ_from_zero("angle_noise")
    assert randomizer.can_differ_from_zero("cart_mass")
    assert not randomizer.can_differ_from_zero("position_noise")
