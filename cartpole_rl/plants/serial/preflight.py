"""The preflight: checks of a cart in order, by small moves that show its wiring, limits and latency.

Each check relies only on checks that passed before. It moves the cart a few centimetres at most, brings it
back to the middle, and returns its result as text. It raises NotReadyError, which says what is wrong and what
to do about it. Signs as in `moves.py`.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from cartpole_rl.errors import FaultError, PlantError
from cartpole_rl.plants.measured import BlindMotion
from cartpole_rl.plants.serial.cart import RESTARTED, SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError, check_limits, check_period, check_rig
from cartpole_rl.plants.serial.moves import (
    LEFT,
    NO_MOTION,
    RIGHT,
    SURELY,
    UNSEEN_MOTION,
    ArmedCart,
    centre,
    gentle_motor,
    nominal_deadband,
)
from cartpole_rl.plants.serial.preparation import FaultClearing
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.terminal import waiting
from cartpole_rl.wire.messages import Fault, Flags, Info, State, seconds_between, ticks_between

FARTHEST = 0.08  # m from the middle: no check needs more
LEAST_SPEED = 0.03  # m/s of the way back to the middle; slower would take long and show nothing
NEAR = 0.004  # m from the middle: no check needs to start closer
RAMP_STEP = 1  # motor values per period
SMALL_SWING = 3.5  # degrees peak to peak; pushes the cart like three motor values
SHORT_PATIENCE = 5.0  # s
MOVED = 0.09e-3  # m, more than a pole that swings can press into the gears' play

QUESTIONS = 25  # asked over the link
LOST_SHARE = 0.05  # of the frames; a good cable loses none
PERIOD_TOLERANCE = 0.02  # of the period in INFO
ROUND_TRIP_SHARE = 0.5  # of a period: a command that comes later acts in the next one

SURELY_MOVED = 0.001  # m
POLE_MOVED = 1.0  # degrees; more, where the pole still swings
PUSH = 1.4  # m/s^2, of a push in the middle
LONGEST_PUSH, FARTHEST_PUSH = 0.3, 0.035  # s, m
FITTED, COMPARED = 2.0, 2.5  # s: a sine is fitted to the last counts; its error includes earlier ones
SWINGS = np.geomspace(0.4, 2.6, 120)  # s: whole swings of rods of 0.06 m to 2.5 m
NO_SWING, LONG_PATIENCE = 0.5, 15.0  # degrees peak to peak, s
LARGEST_DEADBAND = 150  # motor value; of nine_levels the two weakest, 100 and 150, would not move such a cart
STEPS = 4  # for the latency, two to each side
LONGEST_LATENCY_PERIODS = 2.0  # agents are trained on up to about one period


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    check: str
    ready: bool
    words: str

    def __str__(self) -> str:
        return f"{'OK ' if self.ready else 'BAD'}  {self.check}: {self.words}"


def preflight(cart: SerialCart, faults: FaultClearing | None = None) -> Iterator[Finding]:
    """Check a cart, which need not be open yet, and yield a finding for each check.

    Ends after the first check that fails. The cart is disarmed at the end, and left open. Errors of the link
    and faults of the cart are findings too. `faults` decides whether a latched fault may be cleared; without
    it none is.
    """
    stopped = False
    try:
        for name, check in _checks(cart, faults or FaultClearing(0)).items():
            finding = _finding(name, check, cart)
            if not finding.ready:
                _stop(cart)  # before the caller shows it: the motor may still be on
                stopped = True
            yield finding
            if not finding.ready:
                return
    finally:
        if not stopped:
            _stop(cart)


def _stop(cart: SerialCart) -> None:
    if cart.is_open:
        with suppress(PlantError):  # the finding says why; the cart's watchdog stops it
            cart.stop()


def _checks(cart: SerialCart, faults: FaultClearing) -> dict[str, Callable[[], str]]:
    probe = Probe(cart)
    return {
        "link": lambda: link(cart),
        "limits": lambda: limits(cart.information, cart.flags, cart.hardware),
        "homing": lambda: homing(cart, faults),
        "cart encoder": lambda: cart_direction(probe),
        "pole encoder": lambda: pole_direction(probe),
        "dead-band": lambda: deadband(probe),
        "latency": lambda: latency(probe),
        "soft limit": lambda: soft_limit(probe),
    }


def _finding(name: str, check: Callable[[], str], cart: SerialCart) -> Finding:
    restarts = cart.restarts
    try:
        with waiting(f"checking: {name}", thread=False):
            finding = Finding(name, True, check())
    except PlantError as error:
        finding = Finding(name, False, str(error))
    return finding if cart.restarts == restarts else Finding(name, False, RESTARTED)


class Probe(ArmedCart):
    """An armed cart that is moved a little at a time, and what its moves have shown so far.

    Every move raises NotReadyError when the cart gets too far from the middle, and FaultError when it latches
    a fault. Positions in counts, times by the cart's clock.
    """

    def __init__(self, cart: SerialCart) -> None:
        super().__init__(cart)
        self.deadband: dict[int, int] = {}  # motor value that just moves it, to the RIGHT and to the LEFT
        self.farthest = 0  # counts from the middle
        self.limited = False  # the soft limit has held a motor value back

    def settle(self) -> State:
        """Apply motor 0 until the pole hardly swings, but not for long; return the last state."""
        return self.calm(self.pole_counts(SMALL_SWING), SHORT_PATIENCE)[0][-1]

    def cart_counts(self, metres: float) -> int:
        """Return a distance of the cart in counts, at least one."""
        return max(1, self.hardware.encoders.cart_counts(metres))

    def ramp(self, side: int) -> tuple[int, State, State]:
        """Raise the motor value to one side until the cart moves.

        Returns the size of that value, and the states before and after the move. Raises NotReadyError if the
        count never changes, or must have changed by then.
        """
        before, largest, moved = self.settle(), gentle_motor(self.hardware), self.cart_counts(MOVED)
        blind = BlindMotion(self.hardware, SURELY * self.hardware.breakaway_motor)
        for size in range(RAMP_STEP, largest + 1, RAMP_STEP):
            after = self.drive(side * size)
            if abs(after.cart_counts - before.cart_counts) >= moved:
                return size, before, after
            if blind.is_seen(side * size, after.cart_counts, self.period):
                rough = "or clean the track, and give more moving_friction in its file"
                raise NotReadyError(
                    f"at a motor value of {side * size:+d}, {UNSEEN_MOTION}", f"{NO_MOTION}, {rough}"
                )
        raise NotReadyError(f"motor values up to {side * largest:+d} do not move the cart's count", NO_MOTION)

    def centre(self) -> None:
        """Bring the cart to the middle and to rest. Needs the sign of the cart's count to be right.

        A dead-band that is not measured yet is taken from the other side. Raises NotReadyError if the cart
        does not get there.
        """
        other_side = {-side: motor for side, motor in self.deadband.items()}
        known = nominal_deadband(self.hardware) | other_side | self.deadband
        centre(self, known, NEAR, LEAST_SPEED)
        self.rest()

    def check(self, state: State) -> State:
        """Record the cart's position and return the state. Raises NotReadyError or FaultError."""
        self.farthest = max(self.farthest, abs(state.cart_counts))
        self.limited = self.limited or bool(self.cart.flags & Flags.SOFT_LIMIT)
        super().check(state)
        if self.metres(abs(state.cart_counts)) > FARTHEST:
            self.cart.stop()
            raise NotReadyError(
                f"the cart went {self.metres(state.cart_counts) * 1e3:+.0f} mm, further than any requested "
                "move",
                "put the track level, check the motor driver; of a stepper on plant=text, give plant.damping",
            )
        return state


def link(cart: SerialCart) -> str:
    """Check the period by the cart's own clock, the round trip, and that few frames get lost."""
    check_period(cart.open())
    first, trips = cart.poll_state(), []
    for _ in range(QUESTIONS):
        asked = time.perf_counter()
        information = cart.info()
        trips.append(time.perf_counter() - asked)
        last = cart.poll_state()
    check_period(information)
    trip, period = statistics.median(trips), information.period_us * 1e-6
    measured = seconds_between(first.time_us, last.time_us) / max(1, ticks_between(first.tick, last.tick))
    counted = cart.statistics
    bad = counted.bad_frames + counted.lost_frames
    if bad > LOST_SHARE * (counted.frames_received + counted.lost_frames):
        raise NotReadyError(
            f"{counted.lost_frames} frames were lost and {counted.bad_frames} damaged of "
            f"{counted.frames_received}",
            "use a short shielded cable, away from the motor's; if that does not help, use 115200 baud: "
            "set BAUD in the board's file, flash again, and give plant.baud=115200",
        )
    if abs(measured / period - 1) > PERIOD_TOLERANCE:
        raise NotReadyError(
            f"a period takes {measured * 1e3:.2f} ms by the cart's clock, not {period * 1e3:g} ms as it says",
            "its firmware does too much in a period, or miscounts its time; on plant=text, lines may be lost "
            "or damaged",
        )
    slow = trip > ROUND_TRIP_SHARE * period
    if slow and not cart.is_lockstep:
        raise NotReadyError(
            f"a question is answered after {trip * 1e3:.1f} ms, more than half a period",
            "with an FTDI chip, set its latency_timer in /sys/bus/usb-serial/devices/ to 1; "
            "end what keeps this computer busy",
        )
    version = (information.firmware_major, information.firmware_minor, information.firmware_patch)
    return (
        f"firmware {'.'.join(map(str, version))}, period {measured * 1e3:.2f} ms, "
        f"round trip {trip * 1e3:.1f} ms{' in lockstep' * slow}, "
        f"{bad} of {counted.frames_received} frames bad or lost"
    )


def limits(information: Info, flags: Flags, hardware: Hardware) -> str:
    """Check that the scales, end switches and limits of the cart are those of its file."""
    check_rig(information, flags, hardware)
    check_limits(information, hardware)
    metres = hardware.encoders.metres
    soft, hard = information.soft_limit_counts * metres, information.hard_limit_counts * metres
    return (
        f"soft {soft * 1e3:.0f} mm, hard {hard * 1e3:.0f} mm from the middle; "
        f"{hardware.cart_nanometres_per_count} nm and 1/{hardware.pole_counts_per_turn} turn a count"
    )


def homing(cart: SerialCart, faults: FaultClearing) -> str:
    """Home; check that the cart is in the middle, the pole hangs, and the limits fit the track."""
    if fault := cart.poll_state().fault:
        faults.clear(cart, fault)
    before = cart.get_state()
    state = _homed(cart, before)
    limits(cart.information, cart.flags, cart.hardware)
    turn = cart.hardware.pole_counts_per_turn
    pole, off = (
        (state.pole_counts - turn // 2) * 360 / turn,
        state.cart_counts * cart.hardware.encoders.metres,
    )
    if abs(off) > 0.01 or abs(pole) > 2:
        raise NotReadyError(
            f"after homing the cart is {off * 1e3:+.0f} mm from the middle, "
            f"the pole {pole:+.1f} deg from hanging",
            "keep hands off during homing, check that no gear slips",
        )
    seconds = seconds_between(before.time_us, state.time_us)
    where = f"the cart {off * 1e3:+.1f} mm from the middle, the pole {pole:+.1f} deg from hanging"
    return f"{seconds:.0f} s; {where}"


def _homed(cart: SerialCart, before: State) -> State:
    """Home; return the state after it. Raises NotReadyError if the cart never moved away from `before`."""
    farthest = 0

    def watch(state: State) -> None:
        nonlocal farthest
        farthest = max(farthest, abs(state.cart_counts - before.cart_counts))

    try:
        return cart.home(watch)
    except FaultError:
        if (
            farthest >= cart.hardware.encoders.cart_counts(SURELY_MOVED)
            or cart.poll_state().fault != Fault.HOMING
        ):
            raise
        raise NotReadyError("homing failed: the cart's count does not change", NO_MOTION) from None


def cart_direction(probe: Probe) -> str:
    """Check that a positive motor value moves the count up. Arms the cart."""
    probe.arm()
    value, before, after = probe.ramp(RIGHT)
    for _ in range(probe.periods(LONGEST_PUSH)):
        if abs(after.cart_counts - before.cart_counts) >= probe.cart_counts(SURELY_MOVED):
            break
        after = probe.drive(value + 10)
    moved = after.cart_counts - before.cart_counts
    if moved < 0:
        raise NotReadyError(
            f"motor value {value:+d} moves the cart's count down, by {-moved}",
            "if the cart went right, swap its encoder's wires A and B (plant=text: plant.cart_reversed); "
            "if it went left, swap the motor's two (the sign of plant.full)",
        )
    probe.deadband[RIGHT] = value
    probe.centre()
    return f"motor value {value:+d} moves the count up"


def push_motor(probe: "Probe", side: int) -> int:
    """Return the size of a motor value that pushes the cart gently to a side, beyond its dead-band."""
    hardware = probe.hardware
    push = PUSH * hardware.moving_mass * hardware.motor_per_newton
    return min(gentle_motor(hardware), probe.deadband[side] + round(push))


def pole_direction(probe: Probe) -> str:
    """Check that a push to the right leaves the hanging pole's tip behind, on the left: its count goes up.

    A remaining swing is assumed to go on during the push, and is subtracted.
    """
    no_swing = probe.pole_counts(NO_SWING)
    states, swing = probe.calm(no_swing, LONG_PATIENCE)
    swings = swing > no_swing
    expected, error = swinging_on(probe, [state.pole_counts for state in states], swings)
    before, enough = states[-1], max(probe.pole_counts(POLE_MOVED), no_swing + 2 * error)
    value = push_motor(probe, RIGHT)
    for _ in expected:
        after = probe.drive(value)
        passed = ticks_between(before.tick, after.tick)  # more than one at a time if this computer is late
        swung = after.pole_counts - expected[min(passed, len(expected)) - 1]
        moved = probe.metres(abs(after.cart_counts - before.cart_counts))
        if abs(swung) >= enough or moved > FARTHEST_PUSH or passed >= len(expected):
            break
    if abs(swung) < enough:
        raise NotReadyError(
            f"the pole's count does not follow a push of the cart; it changed by {swung:+d}, and swung by "
            f"{swing} before",
            "let the pole hang still, check the cable of its encoder, and screw the pole tight to its shaft",
        )
    probe.centre()
    if swung < 0:
        raise NotReadyError(
            f"a push to the right moves the hanging pole's count down, by {-swung}",
            "swap the wires A and B of the pole's encoder, or turn its sign in the firmware (plant=text: "
            "plant.pole_reversed)",
        )
    return f"a push to the right swings the hanging pole to the left, {swung:+d} counts"


def swinging_on(probe: Probe, counts: list[int], swings: bool) -> tuple[list[int], int]:
    """Return the next counts of a pole without a push, for LONGEST_PUSH, and their error.

    A small swing is a sine, which is fitted to the counts of the last FITTED seconds. The error is the
    largest difference between that sine and the counts of the last COMPARED seconds.
    """
    pushed, last = probe.periods(LONGEST_PUSH), np.array(counts[-probe.periods(COMPARED) :])
    if not swings:
        return [counts[-1]] * pushed, 0
    times, fitted = probe.period * np.arange(len(last) + pushed), slice(-probe.periods(FITTED), None)

    def sine(seconds: float) -> np.ndarray:
        phase = 2 * math.pi / seconds * times
        shape = np.stack((np.ones_like(phase), np.cos(phase), np.sin(phase)), 1)
        return shape @ np.linalg.lstsq(shape[: len(last)][fitted], last[fitted], rcond=None)[0]

    def error(swing: np.ndarray) -> float:
        return np.abs(swing[: len(last)] - last).max()

    best = min(map(sine, SWINGS), key=error)
    return np.rint(best[len(last) :]).astype(int).tolist(), math.ceil(error(best))


def deadband(probe: Probe) -> str:
    """Measure the smallest motor value that moves the cart, to each side."""
    for side in (RIGHT, LEFT):
        probe.deadband[side], _, _ = probe.ramp(side)
        probe.centre()
    right, left = probe.deadband[RIGHT], probe.deadband[LEFT]
    if max(right, left) > LARGEST_DEADBAND:
        raise NotReadyError(
            f"it takes a motor value of {right:+d} to move the cart right, {-left:+d} left",
            "clean the track and the rack, loosen what rubs, check the motor's supply voltage",
        )
    return f"{right:+d} moves the cart right, {-left:+d} left"


def latency(probe: Probe) -> str:
    """Measure the time from a motor value's arrival at the cart to the start of the motion."""
    measured = [step_latency(probe, side) for side in (RIGHT, LEFT) * (STEPS // 2)]
    middle = statistics.median(seconds for seconds, _ in measured)
    age = statistics.median(age for _, age in measured)
    if middle > LONGEST_LATENCY_PERIODS * probe.period:
        raise NotReadyError(
            f"the cart begins to move {middle * 1e3:.0f} ms after it took a motor value, which is "
            f"{middle / probe.period:.1f} periods",
            "look for a ramp or a filter in the motor driver, and for play in the gears",
        )
    return (
        f"the cart begins to move {middle * 1e3:.0f} ms after it took a motor value, "
        f"and confirms the value after {age * 1e3:.0f} ms"
    )


def step_latency(probe: Probe, side: int) -> tuple[float, float]:
    """Return the latency of one motor step from rest, and the command age in the first state after it, in s.

    With constant acceleration the distance grows with the square of the time since the start of the motion;
    two states during the motion give that start more precisely than a period.
    """
    before = probe.settle()
    value = side * push_motor(probe, side)
    moved = probe.cart_counts(MOVED)
    states = [probe.drive(value)]
    age = states[0].command_age_ms * 1e-3
    taken_us = states[0].time_us - states[0].command_age_ms * 1000
    for _ in range(probe.periods(LONGEST_PUSH)):
        states.append(probe.drive(value))
        distances = [side * (state.cart_counts - before.cart_counts) for state in states[-2:]]
        if moved <= distances[0] < distances[1]:
            break
    probe.centre()
    if not moved <= distances[0] < distances[1]:
        raise NotReadyError(
            f"motor value {value:+d} does not move the cart evenly within {LONGEST_PUSH:g} s",
            "free the cart; look for a ramp or a filter in the motor driver",
        )
    first, second = (seconds_between(taken_us, state.time_us) for state in states[-2:])
    ratio = math.sqrt(distances[0] / distances[1])
    return max(0.0, (first - ratio * second) / (1 - ratio)), age


def soft_limit(probe: Probe) -> str:
    """Check that none of the moves came near the end of the track."""
    limit = probe.cart.information.soft_limit_counts
    if probe.limited or probe.farthest >= limit:
        raise NotReadyError(
            f"the soft limit was reached {probe.metres(probe.farthest) * 1e3:.0f} mm from the middle",
            "check the firmware's limits and the zero that homing set",
        )
    return f"not reached; the cart stayed within {probe.metres(probe.farthest) * 1e3:.0f} mm of the middle"
