"""The statistics of a link: counts, latencies and their percentiles."""

import math

import numpy as np
import pytest

from cartpole_rl.checking import validated
from cartpole_rl.composition import compose
from cartpole_rl.envs.build import randomizer
from cartpole_rl.plants.serial.statistics import LATENCY_SAMPLES, LinkStatistics
from cartpole_rl.workflows.config import TrainConfig


def test_the_newest_samples_stay() -> None:
    times = LinkStatistics().latency
    times.extend(range(LATENCY_SAMPLES + 10))
    assert LATENCY_SAMPLES >= 65536
    assert [*times] == list(range(10, LATENCY_SAMPLES + 10))


def test_percentiles_in_milliseconds() -> None:
    seen = LinkStatistics()
    for number in range(10_001):
        seen.latency.append(number * 1e-6)
    summary = seen.summary()
    assert summary["latency_median_ms"] == pytest.approx(5.0)
    assert summary["latency_p99_ms"] == pytest.approx(9.9)
    assert summary["latency_p999_ms"] == pytest.approx(9.99)
    assert summary["latency_max_ms"] == pytest.approx(10.0)


def test_nothing_measured_is_nan_in_the_summary_and_no_setting() -> None:
    seen = LinkStatistics()
    assert math.isnan(seen.summary()["latency_p999_ms"])
    assert seen.latency_override() is None


def test_the_override_is_a_word_that_cartpole_train_takes() -> None:
    seen = LinkStatistics()
    for seconds in np.linspace(0.002, 0.012, 1001):
        seen.loop_times.append(seconds)
    word = seen.latency_override()
    assert word == "++randomization.latency={distribution: uniform, absolute: [0.0021, 0.0119]}"
    for group in ("none", "wide"):
        config = validated(TrainConfig, compose("train", [f"randomization={group}", word]))
        assert config.randomization["latency"].limits() == (0.0021, 0.0119)
        assert randomizer(config).longest_delay() == pytest.approx(0.0119)


def test_commands_that_come_at_once_leave_nothing_to_hand_on() -> None:
    seen = LinkStatistics()
    seen.loop_times.append(0.0)
    assert seen.latency_override() is None
