"""The statistics of a link: counts, latencies and their percentiles."""

import math

import numpy as np
import pytest

from cartpole_rl.checking import validated
from cartpole_rl.composition import compose
from cartpole_rl.envs.build import randomizer
from cartpole_rl.errors import PlantError
from cartpole_rl.plants.serial.statistics import LATENCY_SAMPLES, LatencyRing, LinkStatistics
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.workflows.config import TrainConfig


def test_the_newest_samples_stay() -> None:
    ring = LatencyRing()
    for number in range(LATENCY_SAMPLES + 10):
        ring.add(number)
    assert LATENCY_SAMPLES >= 65536
    assert sorted(ring.samples()) == list(range(10, LATENCY_SAMPLES + 10))


def test_percentiles_in_milliseconds() -> None:
    seen = LinkStatistics()
    for number in range(10_001):
        seen.latency.add(number * 1e-6)
    summary = seen.summary()
    assert summary.latency_median_ms == pytest.approx(5.0)
    assert summary.latency_p99_ms == pytest.approx(9.9)
    assert summary.latency_p999_ms == pytest.approx(9.99)
    assert summary.latency_max_ms == pytest.approx(10.0)


def test_nothing_measured_is_nan_in_the_summary_and_an_error_as_a_distribution() -> None:
    seen = LinkStatistics()
    assert math.isnan(seen.summary().latency_p999_ms)
    with pytest.raises(PlantError, match="drive the cart first"):
        seen.loop()
    assert seen.latency_override() is None


def test_the_distribution_is_one_that_the_randomization_takes() -> None:
    seen = LinkStatistics()
    for seconds in np.random.default_rng(0).uniform(0.002, 0.012, 5000):
        seen.loop_times.add(seconds)
    low, high = seen.loop()
    assert (low, high) == (pytest.approx(0.0021, abs=1e-4), pytest.approx(0.0119, abs=1e-4))
    assert seen.loop(share=0) == (pytest.approx(0.007, abs=2e-4),) * 2
    Range(absolute=(low, high)).check("latency", 0.005)
    with pytest.raises(ValueError, match="between 0 and 1"):
        seen.loop(share=98)


def test_the_override_is_a_word_that_cartpole_train_takes() -> None:
    seen = LinkStatistics()
    for seconds in np.linspace(0.002, 0.012, 1001):
        seen.loop_times.add(seconds)
    word = seen.latency_override()
    assert word == "++randomization.latency={distribution: uniform, absolute: [0.0021, 0.0119]}"
    for group in ("none", "wide"):
        config = validated(TrainConfig, compose("train", [f"randomization={group}", word]))
        assert config.randomization["latency"].limits() == (0.0021, 0.0119)
        assert randomizer(config).longest_delay() == pytest.approx(0.0119)


def test_commands_that_come_at_once_leave_nothing_to_hand_on() -> None:
    seen = LinkStatistics()
    seen.loop_times.add(0.0)
    assert seen.loop() == (0.0, 0.0)
    assert seen.latency_override() is None
