"""The tracker of states, with ticks and times that a test chooses. Behind a port: test_states.py."""

from dataclasses import replace

import pytest

from cartpole_rl.plants.serial.tracking import IDLE_TICKS, StateTracker
from cartpole_rl.wire.messages import Flags, State


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


@pytest.mark.parametrize(("delay", "late"), [(0.019, 0), (0.021, 1)])
def test_a_command_is_late_after_a_period_in_which_the_tick_advanced(delay: float, late: int) -> None:
    tracker = tracker_of_a_cart()
    drive(tracker, state_at(1), delay)
    tracker.receive(state_at(3), Flags.ARMED, 0.04, 0)
    tracker.hand_out(state_at(3))
    assert tracker.statistics.late_ticks == late
    assert [*tracker.statistics.latency] == [delay]


def test_a_lockstep_cart_waits_and_nothing_is_late() -> None:
    tracker = tracker_of_a_cart()
    drive(tracker, state_at(1), 10.0)
    tracker.receive(state_at(2), Flags.ARMED, 10.0, 0)
    tracker.hand_out(state_at(2))
    assert tracker.statistics.late_ticks == 0


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
