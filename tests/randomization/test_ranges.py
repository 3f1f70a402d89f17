"""One line of randomization: valid lines, and those that are refused."""

import math

import pytest
from pydantic import ValidationError

from cartpole_rl.errors import ConfigError
from cartpole_rl.randomization.ranges import Range


@pytest.mark.parametrize(
    ("line", "limits"),
    [
        ({"absolute": (0.25, 0.9)}, (0.25, 0.9)),
        ({"relative": (-0.2, 0.1)}, (0.8, 1.1)),
        ({"factor": (0.3, 4.8)}, (0.3, 4.8)),
    ],
)
def test_limits(line: dict, limits: tuple[float, float]) -> None:
    assert Range(**line).limits() == pytest.approx(limits)
    assert Range(**line).warped() == pytest.approx(limits)
    assert Range(distribution="log_uniform", **line).warped() == pytest.approx(
        [math.log(edge) for edge in limits]
    )


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ({}, "exactly one of absolute, relative, factor"),
        ({"absolute": (0, 1), "factor": (0, 1)}, "exactly one of absolute, relative, factor"),
        ({"relative": (0.2, -0.2)}, "wrong order"),
        ({"absolute": (0, 1), "distribution": "normal"}, "uniform"),
        ({"absolute": (0, 1), "spread": 2}, "spread"),
        ({"absolute": (0, math.inf)}, "finite"),
    ],
)
def test_senseless_lines_are_refused(line: dict, reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        Range(**line)


@pytest.mark.parametrize(
    ("line", "name", "nominal", "reason"),
    [
        ({"absolute": (-0.1, 0.5)}, "cart_mass", 0.7, "cart_mass reaches -0.1; it must be above 0"),
        ({"relative": (-1.2, 0.2)}, "cart_mass", 0.7, "cart_mass reaches -0.14; it must be above 0"),
        ({"factor": (0.0, 2.0)}, "cart_mass", 0.7, "cart_mass reaches 0; it must be above 0"),
        (
            {"absolute": (0.0, 300.0)},
            "deadband_left",
            0.0,
            "deadband_left reaches 300; it must be at least 0 and",
        ),
        (
            {"relative": (-0.1, 0.1)},
            "track_tilt",
            0.0,
            "track_tilt: relative and factor bounds need a nominal",
        ),
        ({"factor": (0.5, 2.0)}, "latency_jitter", 0.0, "latency_jitter: relative and factor bounds need"),
        (
            {"absolute": (0.0, 0.1), "distribution": "log_uniform"},
            "pole_viscous",
            2e-4,
            "pole_viscous: log_uniform needs bounds above 0",
        ),
    ],
)
def test_impossible_draws_are_refused(line: dict, name: str, nominal: float, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        Range(**line).check(name, nominal)


def test_a_negative_nominal_value_may_be_scaled() -> None:
    Range(relative=(-0.5, 0.5)).check("force_offset", -1.0)
