"""Tracking of the cart's states: which one is the newest, what was lost on the way, what came too late.

Only a state with a newer tick becomes the newest. A tick at or a little below the newest one belongs to a
state that was repeated, or overtaken by a newer one: it is dropped. A tick far below it means that the cart
has restarted.

Late ticks are counted while the host answers states with motor values, or watches a policy on the board: each
state that was passed over, and each state whose command was sent more than a period after the state had
arrived. The second is counted only if the cart's tick advanced meanwhile: a lockstep emulator waits for the
host, so nothing is late there.

The host's own share of the time from a state to its command is measured with the host's clock, to the
microsecond. The whole, from the measurement to the arrival of the command at the cart, is measured by the
cart: its STATEs have the age of the newest command.

There is no I/O and no clock here: the caller passes the times, in s of `link.now`.
"""

import statistics
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from cartpole_rl.plants.serial.errors import LONGEST_PERIOD_US
from cartpole_rl.wire.messages import (
    Flags,
    State,
    microseconds_between,
    seconds_between,
    ticks_between,
    went_back,
)

HALF_MILLISECOND = 500  # us
# After the host's newest frame. A lockstep emulator passes up to three: one for a frame that came twice, and
# two for an older one that came late and twice, and was refused.
IDLE_TICKS = 4
LARGEST_RATE_ERROR = 0.01  # of the cart's clock
OVERTAKEN_TICKS = 16  # 0.3 s: no frame is delayed for longer, and no cart boots and is driven so soon
LATENCY_SAMPLES = 65536  # the newest 22 minutes at 50 Hz
MIDDLE = (0.01, 0.99)  # quantiles of the loop times


def latency_queue() -> deque[float]:
    """Return an empty queue of the newest `LATENCY_SAMPLES` times in s. Its memory does not grow."""
    return deque(maxlen=LATENCY_SAMPLES)


@dataclass
class LinkStatistics:
    """Running counts of one cart over all its connections, without those made while opening a port."""

    frames_received: int = 0  # whole frames of the cart, of every type
    bad_frames: int = 0  # bytes between two 0x00 that are not a frame: checksum, stuffing, type, length
    lost_frames: int = 0  # states that never arrived whole, by the gaps in STATE's tick
    overtaken_frames: int = 0  # states that arrived after a newer one, and were dropped
    repeated_frames: int = 0  # states that arrived once more, and were dropped
    late_ticks: int = 0  # states passed over, or answered later than a period after they came
    latency: deque[float] = field(default_factory=latency_queue)  # s, from a state to its command's end
    loop_times: deque[float] = field(default_factory=latency_queue)  # s, see `latency_override`

    def summary(self) -> dict[str, float]:
        """Return the counts, and the median, 99th and 99.9th percentile and maximum of the latency in ms.

        The latter are NaN without a sample.
        """
        counts = {name: value for name, value in vars(self).items() if isinstance(value, int)}
        times = 1e3 * np.array(self.latency)
        percentiles = np.percentile(times, (50, 99, 99.9, 100)) if len(times) else np.full(4, np.nan)
        keys = "latency_median_ms", "latency_p99_ms", "latency_p999_ms", "latency_max_ms"
        return {**counts, "latency_samples": len(times), **dict(zip(keys, percentiles.tolist(), strict=True))}

    def latency_override(self) -> str | None:
        """Return the range of the middle 98 % of the loop times as a setting of `cartpole-train`.

        A loop time is the time from a state's measurement to the arrival of its command, by the cart's
        clock: the wire both ways and the host between. The time from there to a force at the cart is not
        included; `cartpole-preflight` measures it as `latency`. None without a sample, or if every command
        came at once, as with a lockstep emulator.
        """
        if not self.loop_times:
            return None
        low, high = (round(seconds, 4) for seconds in np.quantile(self.loop_times, MIDDLE).tolist())
        if high <= 0:
            return None
        return f"++randomization.latency={{distribution: uniform, absolute: [{low}, {high}]}}"

    def clear(self) -> None:
        """Reset all counts."""
        vars(self).update(vars(LinkStatistics()))


class StateTracker:
    """The states of one cart, and `statistics` of them over all its connections."""

    def __init__(self) -> None:
        self.statistics = LinkStatistics()
        self.flags = Flags(0)  # of the newest state
        self.restarts = 0  # of the cart, while the port was open
        self.period_us: int | None = None  # by INFO; None before the first INFO of a connection
        self.newest_at = 0.0  # when the newest state arrived
        self.awaits_command = False  # a state was handed out, and its command is not sent yet
        self.measuring = True  # latencies and late ticks are counted
        self.stopped_clock: tuple[State, State] | None = None  # two states between which no time passed
        self.ticks_alone = False  # the cart is known to have a clock of its own
        self.is_lockstep = False  # the cart is known to wait for frames
        self.wrong_rate: float | None = None  # of that clock, by this computer's
        self._clocks = ClockComparison()
        self._same_frame = 0  # ticks in succession that acknowledged the same frame, the newest of the host
        self._newest: State | None = None  # arrived, and not handed out yet
        self.last: State | None = None  # the newest that arrived, handed out or not
        self._missing: set[int] = set()  # ticks that were counted as lost, and may still arrive
        self._catching_up = False  # the operating system dropped states while the host was busy
        self._driving = False  # states are answered with motor values, or a policy on the board is watched
        self._handed_out: State | None = None  # since START
        self.answered_at = 0.0  # when that state arrived
        self._overdue: State | None = None  # its command was sent more than a period after it arrived
        self._commanded: tuple[int, State] | None = None  # sequence of a motor value, and the state before it

    @contextmanager
    def uncounted(self) -> Iterator[LinkStatistics]:
        """Discard what is counted within: a boot banner is not a fault of the link."""
        kept, self.statistics = self.statistics, LinkStatistics()
        try:
            yield self.statistics
        finally:
            self.statistics = kept
            self._missing.clear()

    def disconnect(self) -> None:
        """Forget the states of this connection; the cart may restart before the next one."""
        self._newest = self.last = self.stopped_clock = self.period_us = self.wrong_rate = None
        self.ticks_alone, self._same_frame, self._handed_out = False, 0, None
        self.flags, self._clocks = Flags(0), ClockComparison()
        self._missing.clear()

    def receive(self, state: State, flags: Flags, arrived_at: float, sequence: int) -> bool:
        """Take in a state that has arrived; return True if it is the newest now.

        `sequence` is that of the newest frame that the host has sent.
        """
        last = self.last
        if last is not None:
            if ticks_between(state.tick, last.tick) < OVERTAKEN_TICKS:
                self._count_dropped(state.tick)
                return False
            ticks = ticks_between(last.tick, state.tick)
            if went_back(ticks):
                self.restarts += 1
                self._clocks = ClockComparison()
            else:
                self._compare_clocks(last, state, arrived_at)
                self._check_clock(last, state, ticks)
                self._note_own_clock(last, state, flags, sequence)
                self._count_missing(state.tick, ticks - 1)
        if self._newest is not None:
            self.count_passed_over()
        self.last = self._newest = state
        self.newest_at = arrived_at
        self.flags = flags
        return True

    @property
    def answered_tick(self) -> int:
        """The tick of the state that the next motor value answers: the one handed out, else the newest."""
        state = self._handed_out or self.last
        return 0 if state is None else state.tick

    @property
    def has_handed_out(self) -> bool:
        """True if the caller has got a state since START."""
        return self._handed_out is not None

    def begin_drive(self, armed_by: int) -> None:
        """Note that the frame of a sequence armed the motor: no state from before it is handed out."""
        self._handed_out = None
        if self._newest is not None and not is_newer(self._newest.last_sequence, armed_by):
            self._newest = None

    def take_newest(self) -> State | None:
        """Return the newest state if it was not returned before."""
        state, self._newest = self._newest, None
        return state

    def hand_out(self, state: State) -> None:
        """Note that `state` is handed to the caller, who may answer it with a motor value."""
        self._count_overdue(state)
        self._time_loop(state)
        self._catching_up, self.awaits_command = False, True
        if self._handed_out is not state:
            self._handed_out, self.answered_at = state, self.newest_at

    def send_command(self, sequence: int, sent_at: float) -> None:
        """Note that a motor value was sent."""
        if not self.awaits_command:
            return
        self.awaits_command = False
        if not self.measuring:
            return
        assert self.period_us is not None  # a state was handed out, so INFO is known
        self._driving = True
        self._commanded = None if self._handed_out is None else (sequence, self._handed_out)
        delay = sent_at - self.newest_at
        self.statistics.latency.append(delay)
        self._overdue = self._handed_out if delay > self.period_us * 1e-6 else None

    def send_question(self) -> None:
        """Note that a question is sent, not a motor value: waiting for its answer is not a delay."""
        self._driving = self.awaits_command = False
        self._overdue = self._commanded = None

    def follow_policy(self) -> None:
        """Note that a policy on the board drives: each state should be read."""
        self._driving = True

    def catch_up(self) -> None:
        """Note that states were dropped while the host was busy: until the next `hand_out` none are lost."""
        self._catching_up = True

    def count_passed_over(self) -> None:
        """Count a state that was not answered, if motor values are being sent."""
        if self._driving:
            self.statistics.late_ticks += 1

    def _compare_clocks(self, last: State, state: State, arrived_at: float) -> None:
        """Note the rate of the cart's clock if it is wrong."""
        rate = self._clocks.add(seconds_between(last.time_us, state.time_us), arrived_at)
        if rate is not None and self.ticks_alone and abs(rate - 1) > LARGEST_RATE_ERROR:
            self.wrong_rate = rate

    def _note_own_clock(self, last: State, state: State, flags: Flags, sequence: int) -> None:
        """Note it if the cart ticks on after it has taken the newest frame of the host.

        A lockstep emulator does that only while it homes. It also ticks for each frame that is lost or
        refused, which no state acknowledges.
        """
        idle = state.last_sequence == last.last_sequence == sequence and not flags & Flags.HOMING
        self._same_frame = self._same_frame + 1 if idle else 0
        self.ticks_alone |= self._same_frame >= IDLE_TICKS

    def _check_clock(self, last: State, state: State, ticks: int) -> None:
        """Note it if the cart's clock did not advance between two states: no velocity can be computed.

        After 36 minutes without a state the clock may have wrapped; it is not checked then.
        """
        if self.period_us is None:
            return
        passed = microseconds_between(last.time_us, state.time_us)
        long_ago = went_back(ticks * min(self.period_us, LONGEST_PERIOD_US))
        if passed == 0 or (went_back(passed) and not long_ago):
            self.stopped_clock = last, state

    def _count_missing(self, tick: int, states: int) -> None:
        """Count states before `tick` that did not arrive: lost on the way, or dropped by a busy host."""
        if not self._catching_up:
            self.statistics.lost_frames += states
            newest = min(states, OVERTAKEN_TICKS)
            missing = self._missing | {ticks_between(age, tick) for age in range(1, newest + 1)}
            self._missing = {each for each in missing if ticks_between(each, tick) < OVERTAKEN_TICKS}
        elif self._driving:
            self.statistics.late_ticks += states

    def _count_dropped(self, tick: int) -> None:
        """Count a state that was overtaken, and so was not lost, or that arrived twice."""
        statistics = self.statistics
        if tick in self._missing:
            self._missing.remove(tick)
            statistics.lost_frames = max(0, statistics.lost_frames - 1)  # its loss may not have been counted
            statistics.overtaken_frames += 1
        else:
            statistics.repeated_frames += 1

    def _count_overdue(self, state: State) -> None:
        """Count a state whose command took over a period, if more than one tick lies between by the cart."""
        overdue, self._overdue = self._overdue, None
        if overdue is not None and ticks_between(overdue.tick, state.tick) != 1:
            self.statistics.late_ticks += 1

    def _time_loop(self, state: State) -> None:
        """Note the time from the measurement of a state to the arrival of its command at the cart.

        STATE has the age of the command in whole milliseconds, rounded down: half a millisecond is added.
        """
        commanded, self._commanded = self._commanded, None
        if commanded is None or state.last_sequence != commanded[0]:
            return
        passed_us = microseconds_between(commanded[1].time_us, state.time_us)
        if not went_back(passed_us):  # otherwise the cart has restarted
            until_arrival_us = passed_us - 1000 * state.command_age_ms - HALF_MILLISECOND
            self.statistics.loop_times.append(max(0, until_arrival_us) * 1e-6)


def is_newer(sequence: int, than: int) -> bool:
    """Return True if the frame of a sequence was sent after that of another, or is the same."""
    return (sequence - than) % 256 < 128


class ClockComparison:
    """Compares the clock of a cart with this computer's, by the arrivals of its states.

    An arrival can be late but never early: of each second by the cart's clock the earliest counts. The median
    of several comparisons is not disturbed by a second in which this computer was busy. After a pause, such
    as a question to a person, what waited in a buffer comes at once: a comparison begins anew after that.
    """

    SECONDS = 8  # that are compared, the newest
    LONGEST_PAUSE = 0.5  # s between two arrivals; the longest period is 0.1 s
    CATCHING_UP = 1.0  # s after a pause and at first; what waited has been read by then

    def __init__(self) -> None:
        self._earliest: list[float] = []  # s that the host's clock was ahead, of each second so far
        self._elapsed = 0.0  # s by the cart's clock since the first state
        self._second = -1  # that is under way
        self._arrived_at: float | None = None  # of the last state
        self._late_until = 0.0

    def add(self, elapsed: float, arrived_at: float) -> float | None:
        """Add a state, `elapsed` s after the last one by the cart's clock, that arrived at a time in s.

        Returns the rate of the cart's clock (1.3: it passes 1.3 s in a second) when a second has ended and
        enough have been compared, otherwise None.
        """
        last, self._arrived_at = self._arrived_at, arrived_at
        if last is None or arrived_at - last > self.LONGEST_PAUSE:
            self._late_until = arrived_at + self.CATCHING_UP
        if arrived_at < self._late_until:
            self._earliest, self._elapsed, self._second = [], 0.0, -1
            return None
        self._elapsed += elapsed
        ahead, second = arrived_at - self._elapsed, int(self._elapsed)
        if second == self._second:
            self._earliest[-1] = min(self._earliest[-1], ahead)
            return None
        rate = self._rate()
        self._earliest = [*self._earliest[-self.SECONDS :], ahead] if second == self._second + 1 else [ahead]
        self._second = second
        return rate

    def _rate(self) -> float | None:
        complete, half = self._earliest[1:], self.SECONDS // 2  # the first second was cut short
        if len(complete) < self.SECONDS:
            return None
        drifts = [(after - before) / half for before, after in zip(complete, complete[half:], strict=False)]
        return 1 / max(1e-3, 1 + statistics.median(drifts))
