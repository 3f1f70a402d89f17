"""The tracker of states, with ticks and times that a test chooses, and its statistics: counts, latencies.

Behind a port: test_states.py.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from cartpole_rl.checking import validated
from cartpole_rl.composition import compose
from cartpole_rl.envs.build import randomizer
from cartpole_rl.plants.serial.tracking import IDLE_TICKS, LATENCY_SAMPLES, LinkStatistics, StateTracker
from cartpole_rl.wire.messages import Flags, State
from cartpole_rl.workflows.config import TrainConfig


def state_at(tick: int) -> State:
    return State(tick, tick * 20_000, 0, 2048, 0, 0, 0, 0)


def tracker_of_a_cart() -> StateTracker:
    tracker = StateTracker()
    tracker.period_us = 20_000
    return tracker


def drive(tracker: StateTracker, state: State, delay: float) -> None:
    """A state arrives at 0 s, and is answered with a motor value `delay` s later."""
    tracker.receive(state, Flags.ARMED, 0.0, 0)
    tracker.take_newest()
    tracker.hand_out(state)
    tracker.send_command(1, delay)


@pytest.mark.parametrize("first", [0, 2**32 - 6, 2**32 - 7])
def test_only_a_newer_state_becomes_the_newest(first: int) -> None:
    """Across the wrap of the tick too."""
    tracker = tracker_of_a_cart()
    ticks = [(first + tick) % 2**32 for tick in (5, 7, 6, 7, 4, 8)]
    taken = [tracker.receive(replace(state_at(0), tick=tick), Flags.ARMED, 0.0, 0) for tick in ticks]
    assert taken == [True, True, False, False, False, True]
    seen = tracker.statistics
    assert (seen.lost_frames, seen.overtaken_frames, seen.repeated_frames) == (0, 1, 2)
    newest = tracker.take_newest()
    assert newest is not None
    assert newest.tick == ticks[-1]
    assert tracker.take_newest() is None


def test_a_restart_is_counted_and_its_state_taken() -> None:
    tracker = tracker_of_a_cart()
    tracker.receive(state_at(5000), Flags.ARMED, 0.0, 0)
    assert tracker.receive(state_at(2), Flags(0), 0.02, 0)
    assert tracker.restarts == 1
    assert tracker.flags == Flags(0)
    assert tracker.statistics.lost_frames == 0


def test_another_connection_begins_without_the_states_of_the_last_one() -> None:
    tracker = tracker_of_a_cart()
    tracker.receive(state_at(5), Flags.HOMED, 0.0, 0)
    tracker.receive(replace(state_at(6), time_us=state_at(5).time_us), Flags.HOMED, 0.02, 0)
    assert tracker.stopped_clock is not None
    tracker.disconnect()
    assert tracker.stopped_clock is None
    assert tracker.take_newest() is None
    tracker.receive(state_at(1000), Flags.HOMED, 9.0, 0)
    assert (tracker.restarts, tracker.statistics.lost_frames) == (0, 0)


@pytest.mark.parametrize(
    ("delay", "tick", "late"),
    [(0.019, 3, 0), (0.021, 3, 1), (10.0, 2, 0)],
    ids=["in time", "late", "a lockstep cart waits"],
)
def test_a_command_is_late_after_a_period_in_which_the_tick_advanced(
    delay: float, tick: int, late: int
) -> None:
    tracker = tracker_of_a_cart()
    drive(tracker, state_at(1), delay)
    tracker.receive(state_at(tick), Flags.ARMED, 0.04, 0)
    tracker.hand_out(state_at(tick))
    assert tracker.statistics.late_ticks == late
    assert [*tracker.statistics.latency] == [delay]


def test_a_state_that_is_passed_over_is_late_only_while_driving() -> None:
    tracker = tracker_of_a_cart()
    for tick in (1, 2):
        tracker.receive(state_at(tick), Flags.ARMED, 0.0, 0)
    assert tracker.statistics.late_ticks == 0
    tracker.take_newest()
    tracker.hand_out(state_at(2))
    tracker.send_command(1, 0.0)
    for tick in (3, 4):
        tracker.receive(state_at(tick), Flags.ARMED, 0.02, 0)
    assert tracker.statistics.late_ticks == 1
    tracker.send_question()
    tracker.receive(state_at(5), Flags.ARMED, 0.06, 0)
    assert tracker.statistics.late_ticks == 1


def test_a_lockstep_cart_with_frames_that_come_twice_has_no_clock_of_its_own() -> None:
    """Frame 55 came twice, and 54 after it, twice too: it was refused, and no state acknowledges it."""
    tracker = tracker_of_a_cart()
    for tick, taken in enumerate((52, 53, 53, 55, 55, 55, 55)):
        tracker.receive(replace(state_at(tick), last_sequence=taken), Flags.ARMED, 0.0, 55)
    assert not tracker.ticks_alone


@pytest.mark.parametrize(
    ("sequence", "flags", "alone"),
    [(0, Flags.ARMED, True), (1, Flags.ARMED, False), (0, Flags.HOMING, False)],
    ids=["idle", "newest frame lost or refused", "homing"],
)
def test_a_cart_has_its_own_clock_if_it_ticks_on_after_the_newest_frame(
    sequence: int, flags: Flags, alone: bool
) -> None:
    tracker = tracker_of_a_cart()
    for tick in range(IDLE_TICKS):
        tracker.receive(state_at(tick), flags, 0.0, sequence)
    assert not tracker.ticks_alone
    for tick in range(IDLE_TICKS, 12):
        tracker.receive(state_at(tick), flags, 0.0, sequence)
    assert tracker.ticks_alone == alone


def test_the_hosts_own_moves_are_not_measured() -> None:
    tracker = tracker_of_a_cart()
    tracker.measuring = False
    drive(tracker, state_at(1), 10.0)
    assert not tracker.statistics.latency
    assert not tracker.awaits_command


def test_the_newest_samples_stay() -> None:
    times = LinkStatistics().latency
    times.extend(range(LATENCY_SAMPLES + 10))
    assert LATENCY_SAMPLES >= 65536
    assert [*times] == list(range(10, LATENCY_SAMPLES + 10))


def test_percentiles_in_milliseconds() -> None:
    seen = LinkStatistics()
    seen.latency.extend(number * 1e-6 for number in range(10_001))
    expected = {"median": 5.0, "p99": 9.9, "p999": 9.99, "max": 10.0}
    summary = seen.summary()
    assert {key: summary[f"latency_{key}_ms"] for key in expected} == pytest.approx(expected)


def test_nothing_measured_is_nan_in_the_summary_and_no_setting() -> None:
    """Nor are commands that come at once."""
    seen = LinkStatistics()
    assert math.isnan(seen.summary()["latency_p999_ms"])
    assert seen.latency_override() is None
    seen.loop_times.append(0.0)
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
