"""Metrics of hand-made episodes, and the coverage of the intervals."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cartpole_rl.evaluation.metrics import episode_metrics, interval, summarize
from cartpole_rl.tasks.episode import Episode

PERIOD = 0.02
DEGREE = math.pi / 180


def episode(theta: list[float], x: list[float] | None = None, motor: list[int] | None = None) -> Episode:
    """Angles (degrees) and positions (m) at T+1 moments; scores 1, 2, 3, ... and tenths of them."""
    steps = len(theta) - 1
    score = np.arange(1.0, steps + 1)
    rest = np.zeros(steps + 1)
    return Episode(
        time=np.arange(steps + 1) * PERIOD,
        x=np.array(x or rest),
        x_dot=rest,
        theta=np.array(theta) * DEGREE,
        theta_dot=rest,
        counts=np.zeros((steps + 1, 2), int),
        motor=np.array(motor or [0] * steps),
        score=score,
        score_upright=score / 10,
        reward=-score,
        ended_by="time",
    )


def test_sums_and_steps() -> None:
    metrics = episode_metrics(episode([180, 170, 160, 150]), 0.4)
    assert metrics["score"] == 6
    assert metrics["score_upright"] == pytest.approx(0.6)
    assert metrics["reward"] == -6
    assert metrics["steps"] == 3
    assert metrics["ended_by"] == "time"


def test_metrics_over_the_upright_part_are_none_without_one() -> None:
    metrics = episode_metrics(episode([180, 170, 160, 150]), 0.4)
    assert metrics["upright_fraction"] == 0
    assert metrics["time_to_upright_s"] is None
    assert metrics["rms_angle_rad"] is None
    assert metrics["rms_position_m"] is None


def test_rms_is_over_the_upright_part_alone() -> None:
    """The start is not counted, 363 degrees are 3, and 6 is beyond the 5 degrees of upright."""
    metrics = episode_metrics(episode([0, 90, 363, -4, 6], x=[0.3, 0.3, 0.1, -0.2, 0.3]), 0.4)
    assert metrics["upright_fraction"] == 0.5
    assert metrics["rms_angle_rad"] == pytest.approx(math.sqrt((9 + 16) / 2) * DEGREE)
    assert metrics["rms_position_m"] == pytest.approx(math.sqrt((0.01 + 0.04) / 2))


def test_time_to_upright_is_the_start_of_lasting_balance() -> None:
    passing = [180.0] * 10 + [0.0] * 20 + [90.0] * 10  # upright at 0.2 s, for 0.4 s
    metrics = episode_metrics(episode(passing + [1.0] * 60), 0.4)
    assert metrics["time_to_upright_s"] == pytest.approx(40 * PERIOD)
    assert episode_metrics(episode(passing + [1.0] * 40), 0.4)["time_to_upright_s"] is None


def test_motor_change_and_margin() -> None:
    metrics = episode_metrics(episode([0, 0, 0, 0], x=[0, -0.3, 0.1, 0], motor=[100, -200, -200]), 0.4)
    assert metrics["rms_motor_change"] == pytest.approx(math.sqrt(300**2 / 2))
    assert metrics["min_track_margin_m"] == pytest.approx(0.1)
    assert episode_metrics(episode([0, 0], x=[0, 0.5]), 0.4)["min_track_margin_m"] == pytest.approx(-0.1)


def test_equal_values_have_an_interval_without_width() -> None:
    assert interval([3.0, 3.0, 3.0]) == (3.0, 3.0)


def test_values_equal_but_for_rounding_have_a_finite_interval(recwarn: pytest.WarningsRecorder) -> None:
    low, high = interval([1.0] * 9 + [float(np.nextafter(1, 2))])
    assert low <= 1.0 <= high
    assert high - low < 1e-12
    assert not recwarn.list


def test_interval_coverage_is_about_nominal() -> None:
    """Of 200 samples of twenty skewed values, some 190 intervals; BCa is known to fall short a little."""
    random = np.random.default_rng(0)
    hits = 0
    for _ in range(200):
        low, high = interval(random.exponential(2.0, 20))
        hits += low < 2.0 < high
    assert 174 <= hits <= 198


def test_an_interval_is_the_same_each_time_and_narrows_with_more_values() -> None:
    values = np.random.default_rng(1).normal(100, 10, 400)
    assert interval(values) == interval(values)
    few, many = interval(values[:20]), interval(values)
    assert many[1] - many[0] < 0.5 * (few[1] - few[0])


def test_the_summary_counts_endings_and_skips_missing_metrics() -> None:
    upright, hanging = episode([180] + [0.0] * 60), episode([180.0] * 3)
    summary = summarize([episode_metrics(each, 0.4) for each in (upright, hanging, hanging)])
    assert summary["ended_by"] == {"time": 3}
    assert summary["steps"]["mean"] == pytest.approx((60 + 2 + 2) / 3)
    assert summary["steps"]["low"] <= summary["steps"]["mean"] <= summary["steps"]["high"]
    assert summary["time_to_upright_s"] == {"mean": PERIOD, "low": None, "high": None, "count": 1}
    alone = summarize([episode_metrics(hanging, 0.4)])
    assert alone["time_to_upright_s"] is None


@pytest.mark.parametrize(
    ("last", "stands"), [([0.0] * 51, 1), ([6.0] + [0.0] * 49, 0), ([0.0] * 50 + [6.0], 0)]
)
def test_the_pole_is_upright_at_the_end_if_it_was_during_the_last_second(
    last: list[float], stands: int
) -> None:
    assert episode_metrics(episode([90.0] * 20 + last), 0.4)["upright_at_end"] == stands


def test_an_episode_of_less_than_a_second_does_not_end_upright() -> None:
    assert episode_metrics(episode([0.0] * 50), 0.4)["upright_at_end"] == 0


def test_an_upright_pole_on_a_cart_that_left_its_track_does_not_stand_at_the_end() -> None:
    left = replace(episode([0.0] * 80), ended_by="track")
    assert episode_metrics(left, 0.4)["upright_at_end"] == 0
