"""Metrics of hand-made episodes, and the coverage of the intervals."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from cartpole_rl.evaluation.metrics import episode_metrics, interval, summarize
from cartpole_rl.tasks.episode import Episode, Origin

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


def test_sums_and_steps_and_none_of_an_upright_part() -> None:
    metrics = episode_metrics(episode([180, 170, 160, 150]), 0.4)
    assert (metrics["score"], metrics["reward"], metrics["steps"]) == (6, -6, 3)
    assert metrics["score_upright"] == pytest.approx(0.6)
    assert metrics["ended_by"] == "time"
    assert metrics["upright_fraction"] == 0
    assert all(metrics[name] is None for name in ("time_to_upright_s", "rms_angle_rad", "rms_position_m"))


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
    assert metrics["motor_reversals_per_s"] == pytest.approx(1 / (3 * PERIOD))
    assert metrics["min_track_margin_m"] == pytest.approx(0.1)
    assert episode_metrics(episode([0, 0], x=[0, 0.5]), 0.4)["min_track_margin_m"] == pytest.approx(-0.1)
    simulated = replace(episode([0, 0], x=[0, 0.5]), origin=Origin({"track_half_length": 0.35}, {}))
    assert episode_metrics(simulated, 0.4)["min_track_margin_m"] == pytest.approx(-0.15)


def test_a_motor_that_rests_between_two_directions_changes_its_direction_once() -> None:
    metrics = episode_metrics(episode([0] * 9, motor=[9, 9, 0, 0, -9, 0, -9, 9]), 0.4)
    assert metrics["motor_reversals_per_s"] == pytest.approx(2 / (8 * PERIOD))


def test_equal_values_have_a_narrow_interval_without_a_warning(recwarn: pytest.WarningsRecorder) -> None:
    assert interval([3.0, 3.0, 3.0]) == (3.0, 3.0)
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


def test_an_interval_of_many_values_needs_little_memory() -> None:
    values = np.random.default_rng(2).exponential(2.0, 6000)
    tracemalloc.start()
    try:
        low, high = interval(values)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert low < values.mean() < high
    assert most < 300e6  # bytes


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
    ("angles", "ended_by", "stands"),
    [
        ([90.0] * 20 + [0.0] * 51, "time", 1),
        ([90.0] * 20 + [6.0] + [0.0] * 49, "time", 0),
        ([90.0] * 20 + [0.0] * 50 + [6.0], "time", 0),
        ([0.0] * 50, "time", 0),  # less than a second
        ([0.0] * 80, "track", 0),
    ],
)
def test_the_pole_is_upright_at_the_end_if_it_was_during_the_last_second_on_the_track(
    angles: list[float], ended_by: str, stands: int
) -> None:
    whole = replace(episode(angles), ended_by=ended_by)
    assert episode_metrics(whole, 0.4)["upright_at_end"] == stands


@pytest.mark.parametrize(
    ("after", "falls", "recovered", "seconds", "swings"),
    [
        ([80.0] * 10 + [0.0] * 51, 0, None, None, None),  # it stays above the horizontal
        ([*np.linspace(6, 354, 71), *[360.0] * 300], 1, 1, 72, 1),
        ([*np.linspace(6, 200, 40), *np.linspace(200, 6, 40), *[0.0] * 300], 1, 1, 81, 2),
        ([*np.linspace(6, 354, 71), *[360.0] * 40, *[170.0] * 200], 1, 0, None, None),  # upright for 0.8 s
        ([180.0] * 260 + [0.0] * 60, 1, 0, None, None),  # after 5.2 s
        ([*np.linspace(6, 354, 71), *[360.0] * 60], 1, None, None, None),  # too late for 5 s to recover in
        ([180.0] * 300 + [math.nan], 1, 0, None, None),
    ],
)
def test_falls_of_a_pole_that_stood(
    after: list[float], falls: int, recovered: float | None, seconds: float | None, swings: float | None
) -> None:
    """The first upright second is no recovery: the pole has not fallen yet."""
    metrics = episode_metrics(episode([180.0] * 20 + [0.0] * 51 + after), 0.4)
    assert metrics["falls"] == falls
    assert metrics["recovered_fraction"] == recovered
    assert metrics["recovery_s"] == (seconds and pytest.approx(seconds * PERIOD))
    assert metrics["recovery_swings"] == swings


def test_each_fall_counts_and_recoveries_are_averaged() -> None:
    fall, stand = [0.0, 120.0, 180.0, 240.0], [360.0] * 60
    metrics = episode_metrics(episode([0.0] * 60 + fall + stand + fall + [240.0] * 30 + [360.0] * 400), 0.4)
    assert (metrics["falls"], metrics["recovered_fraction"]) == (2, 1)
    assert metrics["recovery_s"] == pytest.approx((4 + 34) / 2 * PERIOD)
    assert metrics["recovery_swings"] == 1


def test_a_fall_after_which_the_cart_leaves_the_track_is_no_recovery() -> None:
    fallen = episode([0.0] * 60 + [180.0] * 20)
    assert episode_metrics(fallen, 0.4)["recovered_fraction"] is None
    assert episode_metrics(replace(fallen, ended_by="track"), 0.4)["recovered_fraction"] == 0
