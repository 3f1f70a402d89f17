"""Small moves that tell whether a cart on a wire is wired and limited, and as quick, as agents take it to be.

Each check is a function that moves the cart a few centimetres at most, brings it back to the middle, and
returns what it found in words. It raises `NotReadyError`, which says what is wrong and what to do about it.

Signs: a positive motor value moves the cart to the right, and the cart count up. The hanging pole of a cart
that speeds up to the right stays behind: its tip swings left, its angle grows beyond pi, its count goes up.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from cartpole_rl.errors import PlantError
from cartpole_rl.physics.encoders import POLE_COUNTS_PER_TURN
from cartpole_rl.plants.serial.cart import RESTARTED, SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.faults import FaultClearing
from cartpole_rl.plants.serial.information import NANOMETRES_PER_COUNT, check_limits, check_scales
from cartpole_rl.plants.serial.moves import GENTLE_MOTOR, ArmedCart, metres
from cartpole_rl.wire import Flags, Info, State, seconds_between, ticks_between

QUESTIONS = 25  # asked over the link
LOST_SHARE = 0.05  # of the frames; a good cable loses none
PERIOD_TOLERANCE = 0.02  # of the period that INFO tells
ROUND_TRIP_SHARE = 0.5  # of a period: a command that comes later acts in the next one

CENTRED = 0.004  # m
FARTHEST = 0.08  # m from the middle: no check needs more
LONGEST_RETURN = 15.0  # s
RETURN_SECONDS = 0.5  # the way back is covered as fast as if it took so long, but no ...
SLOWEST_RETURN, FASTEST_RETURN = 0.03, 0.1  # m/s ... slower and faster than this
RETURN_GAIN = 150.0  # motor values per m/s that the cart is too slow
RETURN_INTEGRAL = 1250.0  # motor values per m of way that it is behind
RAMP_STEP = 1  # motor values a period
MOVED = 4  # counts, 0.09 mm: more than a pole that swings can press into the gears' play
SURELY_MOVED = 44  # counts, 1 mm
POLE_MOVED = 14  # counts; more, where the pole still swings
PUSH = 60  # motor values above the dead-band: about 1.5 m/s^2
LONGEST_PUSH, FARTHEST_PUSH = 0.3, 0.035  # s, m
DRIFT = 4  # periods over which a swing that is left is measured
NO_SWING, LONG_PATIENCE = 6, 15.0  # counts peak to peak, s
SMALL_SWING, SHORT_PATIENCE = 40, 5.0  # presses the cart as much as three motor values do
LARGEST_DEADBAND = 150  # motor value; of nine_levels the two weakest, 100 and 150, would not move such a cart
STEPS = 4  # for the latency, two to each side
LONGEST_LATENCY_PERIODS = 2.0  # what agents are trained on reaches about one period


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    check: str
    ready: bool
    words: str

    def __str__(self) -> str:
        return f"{'OK ' if self.ready else 'BAD'}  {self.check}: {self.words}"


@dataclass
class Moves(ArmedCart):
    """An armed cart that is moved a little at a time, and what it has shown of itself.

    Every move raises NotReadyError when the cart gets too far from the middle, and FaultError when it latches
    a fault. Positions in counts, times by the cart's clock.
    """

    deadband: dict[int, int] = field(
        default_factory=dict
    )  # motor value that moves it, right (1) and left (-1)
    farthest: int = 0  # counts from the middle
    limited: bool = False  # the soft limit has held a motor value back

    def ramp(self, side: int) -> tuple[int, State, State]:
        """Raise the motor value to one side until the cart moves; the value, and the states before and after.

        Raises NotReadyError if it never moves.
        """
        before = self.calm(SMALL_SWING, SHORT_PATIENCE)[0][-1]
        for size in range(RAMP_STEP, GENTLE_MOTOR + 1, RAMP_STEP):
            after = self.drive(side * size)
            if abs(after.cart_counts - before.cart_counts) >= MOVED:
                return size, before, after
        raise NotReadyError(
            f"motor values up to {side * GENTLE_MOTOR:+d} do not move the cart's count",
            "switch the motor's supply on, check the cables of the motor and of the cart's encoder, "
            "free the cart",
        )

    def centre(self) -> None:
        """Bring the cart back to the middle, gently, and let it stand. Raises NotReadyError if that fails.

        A speed servo on top of the dead-band; needs the cart's direction to be right.
        """
        state, speed, push, side = self.rest(), 0.0, 0.0, 0
        for _ in range(self.periods(LONGEST_RETURN)):
            away = metres(-state.cart_counts)
            if abs(away) < CENTRED:
                self.rest()
                return
            if side * away <= 0:
                side, push = (1 if away > 0 else -1), 0.0
            lag = side * min(FASTEST_RETURN, max(SLOWEST_RETURN, abs(away) / RETURN_SECONDS)) - speed
            push += RETURN_INTEGRAL * lag * self.period
            base = self.deadband.get(side) or self.deadband.get(-side, 0)
            motor = side * base + RETURN_GAIN * lag + push
            before, state = state, self.drive(round(max(-GENTLE_MOTOR, min(GENTLE_MOTOR, motor))))
            speed = metres(state.cart_counts - before.cart_counts) / self.period
        raise NotReadyError(
            f"the cart does not come back to the middle; it is {metres(state.cart_counts) * 1e3:+.0f} mm off",
            "free the cart, put the track level",
        )

    def seen(self, state: State) -> State:
        """Note where the cart is; raise what is wrong with that."""
        self.farthest = max(self.farthest, abs(state.cart_counts))
        self.limited = self.limited or bool(self.cart.flags & Flags.SOFT_LIMIT)
        super().seen(state)
        if metres(abs(state.cart_counts)) > FARTHEST:
            self.cart.stop()
            raise NotReadyError(
                f"the cart went {metres(state.cart_counts) * 1e3:+.0f} mm, more than any move that was asked",
                "put the track level, check the motor driver",
            )
        return state


def preflight(
    cart: SerialCart, home_timeout: float = 120.0, faults: FaultClearing | None = None
) -> Iterator[Finding]:
    """Check a cart, which need not be open yet, in an order in which no check builds on one that failed.

    Yields a finding each; ends after the first that is not ready. The cart is disarmed at the end, and left
    open. Errors of the link and faults of the cart are findings too. `faults` decides whether a latched fault
    may be cleared; without it none is.
    """
    moves, clearing = Moves(cart), faults or FaultClearing(0)
    checks: dict[str, Callable[[], str]] = {
        "link": lambda: link(cart),
        "limits": lambda: limits(cart.information),
        "homing": lambda: homing(cart, home_timeout, clearing),
        "cart encoder": lambda: cart_direction(moves),
        "pole encoder": lambda: pole_direction(moves),
        "dead-band": lambda: deadband(moves),
        "latency": lambda: latency(moves),
        "soft limit": lambda: soft_limit(moves),
    }
    try:
        for name, check in checks.items():
            restarts = cart.restarts
            try:
                finding = Finding(name, True, check())
            except PlantError as error:
                finding = Finding(name, False, str(error))
            if cart.restarts > restarts:  # whatever the check made of it
                finding = Finding(name, False, RESTARTED)
            yield finding
            if not finding.ready:
                return
    finally:
        if cart.is_open:
            with suppress(PlantError):  # the finding says why; the cart's watchdog stops it
                cart.stop()


def link(cart: SerialCart) -> str:
    """INFO, the period by the cart's own clock, the round trip, and whether frames get lost."""
    cart.open()
    first, trips = cart.poll_state(), []
    for _ in range(QUESTIONS):
        asked = time.perf_counter()
        information = cart.info()
        trips.append(time.perf_counter() - asked)
        last = cart.poll_state()
    trip, period = statistics.median(trips), information.period_us * 1e-6
    measured = seconds_between(first.time_us, last.time_us) / max(1, ticks_between(first.tick, last.tick))
    seen = cart.statistics
    bad = seen.bad_frames + seen.lost_frames
    if bad > LOST_SHARE * (seen.frames_received + seen.lost_frames):
        raise NotReadyError(
            f"{seen.lost_frames} frames were lost and {seen.bad_frames} spoilt of {seen.frames_received}",
            "use a short shielded cable, away from the motor's, or baud=115200",
        )
    if abs(measured / period - 1) > PERIOD_TOLERANCE:
        raise NotReadyError(
            f"a period takes {measured * 1e3:.2f} ms by the cart's clock, not {period * 1e3:g} ms as it says",
            "its firmware does too much in a period, or miscounts its time",
        )
    if trip > ROUND_TRIP_SHARE * period:
        raise NotReadyError(
            f"a question is answered after {trip * 1e3:.1f} ms, more than half a period",
            "with an FTDI chip, set its latency_timer in /sys/bus/usb-serial/devices/ to 1; "
            "end what keeps this computer busy",
        )
    version = (information.firmware_major, information.firmware_minor, information.firmware_patch)
    return (
        f"firmware {'.'.join(map(str, version))}, period {measured * 1e3:.2f} ms, "
        f"round trip {trip * 1e3:.1f} ms, {bad} of {seen.frames_received} frames bad or lost"
    )


def limits(information: Info) -> str:
    """Check that INFO describes the kind of cart that everything above the wire takes it for."""
    check_scales(information)
    check_limits(information)
    soft, hard = metres(information.soft_limit_counts), metres(information.hard_limit_counts)
    return (
        f"soft {soft * 1e3:.0f} mm, hard {hard * 1e3:.0f} mm from the middle; {NANOMETRES_PER_COUNT} nm and "
        f"1/{POLE_COUNTS_PER_TURN} turn a count"
    )


def homing(cart: SerialCart, timeout: float, faults: FaultClearing) -> str:
    """Home; then the cart is in the middle, the pole hangs, and the limits fit the track."""
    if fault := cart.poll_state().fault:
        faults.clear(cart, fault)
    began = cart.get_state().time_us
    state = cart.home(timeout)
    limits(cart.information)
    pole = (state.pole_counts - POLE_COUNTS_PER_TURN // 2) * 360 / POLE_COUNTS_PER_TURN
    if abs(metres(state.cart_counts)) > 0.01 or abs(pole) > 2:
        raise NotReadyError(
            f"after homing the cart is {metres(state.cart_counts) * 1e3:+.0f} mm from the middle, "
            f"the pole {pole:+.1f} deg from hanging",
            "keep hands off during homing, check that no gear slips",
        )
    seconds = seconds_between(began, state.time_us)
    off = metres(state.cart_counts) * 1e3
    return f"{seconds:.0f} s; the cart {off:+.1f} mm from the middle, the pole {pole:+.1f} deg from hanging"


def cart_direction(moves: Moves) -> str:
    """A positive motor value moves the count up. Arms the cart."""
    moves.arm()
    value, before, after = moves.ramp(+1)
    for _ in range(moves.periods(LONGEST_PUSH)):
        if abs(after.cart_counts - before.cart_counts) >= SURELY_MOVED:
            break
        after = moves.drive(value + 10)
    moved = after.cart_counts - before.cart_counts
    if moved < 0:
        raise NotReadyError(
            f"motor value {value:+d} moves the cart's count down, by {-moved}",
            "if the cart went right, swap its encoder's wires A and B; if it went left, swap the motor's two",
        )
    moves.deadband[+1] = value
    moves.centre()
    return f"motor value {value:+d} moves the count up"


def pole_direction(moves: Moves) -> str:
    """A push to the right leaves the hanging pole's tip behind, on the left: its count goes up.

    What is left of a swing is taken to go on evenly during the push, and does not count.
    """
    states, swing = moves.calm(NO_SWING, LONG_PATIENCE)
    before, drift = states[-1], (states[-1].pole_counts - states[-1 - DRIFT].pole_counts) / DRIFT
    enough = max(POLE_MOVED, NO_SWING + swing // 2)
    value = min(GENTLE_MOTOR, moves.deadband[+1] + PUSH)
    for period in range(1, moves.periods(LONGEST_PUSH) + 1):
        after = moves.drive(value)
        swung = round(after.pole_counts - before.pole_counts - drift * period)
        if abs(swung) >= enough or metres(abs(after.cart_counts - before.cart_counts)) > FARTHEST_PUSH:
            break
    if abs(swung) < enough:
        raise NotReadyError(
            f"the pole's count does not follow a push of the cart; it changed by {swung:+d}, and swung by "
            f"{swing} before",
            "check the cable of the pole's encoder, and that the pole is screwed to its shaft",
        )
    moves.centre()
    if swung < 0:
        raise NotReadyError(
            f"a push to the right moves the hanging pole's count down, by {-swung}",
            "swap the wires A and B of the pole's encoder, or turn its sign in the firmware",
        )
    return f"a push to the right swings the hanging pole to the left, {swung:+d} counts"


def deadband(moves: Moves) -> str:
    """The smallest motor value that moves the cart, to each side."""
    for side in (+1, -1):
        moves.deadband[side], _, _ = moves.ramp(side)
        moves.centre()
    right, left = moves.deadband[+1], moves.deadband[-1]
    if max(right, left) > LARGEST_DEADBAND:
        raise NotReadyError(
            f"it takes a motor value of {right:+d} to move the cart right, {-left:+d} left",
            "clean the track and the rack, loosen what rubs, check the motor's supply voltage",
        )
    return f"{right:+d} moves the cart right, {-left:+d} left"


def latency(moves: Moves) -> str:
    """Time from a motor value's arrival at the cart to the beginning of the motion that it causes."""
    measured = [step_latency(moves, side) for side in (+1, -1) * (STEPS // 2)]
    middle = statistics.median(seconds for seconds, _ in measured)
    age = statistics.median(age for _, age in measured)
    if middle > LONGEST_LATENCY_PERIODS * moves.period:
        raise NotReadyError(
            f"the cart begins to move {middle * 1e3:.0f} ms after it took a motor value, which is "
            f"{middle / moves.period:.1f} periods",
            "look for a ramp or a filter in the motor driver, and for play in the gears",
        )
    return (
        f"the cart begins to move {middle * 1e3:.0f} ms after it took a motor value; the first state that "
        f"knew of the value had a command age of {age * 1e3:.0f} ms"
    )


def step_latency(moves: Moves, side: int) -> tuple[float, float]:
    """Latency of one motor step from rest, and the command's age in the first state that knew of it, in s.

    A cart that is accelerated evenly from a moment on has gone a way that grows with the square of the time
    since then; two states under way tell that moment more finely than a period.
    """
    before = moves.calm(SMALL_SWING, SHORT_PATIENCE)[0][-1]
    value = side * min(GENTLE_MOTOR, moves.deadband[side] + PUSH)
    states = [moves.drive(value)]
    age = states[0].command_age_ms * 1e-3
    taken_us = states[0].time_us - states[0].command_age_ms * 1000
    for _ in range(moves.periods(LONGEST_PUSH)):
        states.append(moves.drive(value))
        ways = [side * (state.cart_counts - before.cart_counts) for state in states[-2:]]
        if MOVED <= ways[0] < ways[1]:
            break
    moves.centre()
    if not MOVED <= ways[0] < ways[1]:
        raise NotReadyError(
            f"motor value {value:+d} does not move the cart evenly within {LONGEST_PUSH:g} s",
            "free the cart; look for a ramp or a filter in the motor driver",
        )
    first, second = (seconds_between(taken_us, state.time_us) for state in states[-2:])
    ratio = math.sqrt(ways[0] / ways[1])
    return max(0.0, (first - ratio * second) / (1 - ratio)), age


def soft_limit(moves: Moves) -> str:
    """None of the moves has come near the end of the track."""
    limit = moves.cart.information.soft_limit_counts
    if moves.limited or moves.farthest >= limit:
        raise NotReadyError(
            f"the soft limit was reached {metres(moves.farthest) * 1e3:.0f} mm from the middle",
            "check the firmware's limits and the zero that homing set",
        )
    return f"not reached; the cart stayed within {metres(moves.farthest) * 1e3:.0f} mm of the middle"
