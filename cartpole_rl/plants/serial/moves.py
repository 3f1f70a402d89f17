"""Small moves of an armed cart, made by the host: to the middle of the track, and the pole to rest.

They are shared by the preflight and by the re-centring between episodes, as homing takes far longer. Motor
values stay below those for which the cart watches for stalls. The cart is armed, so all of its own limits
hold. Only the rough numbers in the cart's file are known here (motor, mass and friction).

Centring: the cart follows a planned speed that slows down towards the middle and changes so gently that the
pole hardly swings. A PI controller turns the lag behind that speed into a force; friction is added as a
feedforward, and the inverse of the motor curve turns the force into a motor value. The motor value that the
friction needs may be known better: the preflight measures the dead-band of each side, the re-centring uses
the nominal one. A dead-band below the nominal one is taken as friction with a smaller offset: an offset
larger than the dead-band would drive the cart the wrong way. The moves in `identification.experiments` do not
use this controller: they are fast on purpose, as part of what is recorded, and work on any plant.

Re-centring: the cart brakes the pole's swing by following it, moves to the middle, and stands until the pole
hangs still; a swing that is left after that is braked again.

Signs: a positive motor value moves the cart to the right, and the cart's count goes up. The hanging pole of a
cart that accelerates to the right stays behind: its tip swings left, its angle grows beyond pi, its count
goes up.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.measured import BlindMotion
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError, fault_error
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.terminal import waiting
from cartpole_rl.wire.messages import State, seconds_between

NO_MOTION = (  # the remedy for a cart whose count does not change
    "switch the motor's supply on, check the cables of the motor and of the cart's encoder, free the cart"
)
UNSEEN_MOTION = "the motor pushes, but the cart's count does not change"

REST_SECONDS = 0.3
RESTS = 45e-6  # m, or two counts: a standing cart moves no more
LONGEST_REST = 10.0  # s
SWING_SECONDS = 1.5  # a whole swing of the large pole takes 1.3 s

LIKELY, SURELY = 1.25, 1.5  # times the motor value that just moves the cart by its file: it moves most carts
CENTRED = 0.002  # m; an episode starts no farther from the middle
LONGEST_CENTRING = 15.0  # s

SMALLEST_FORCE = 0.02  # N; below this the motor is off
RIGHT, LEFT = 1, -1

TRAVEL_SPEED = 0.2  # m/s
SLOWING = 1.0  # s: the speed is what would cover the remaining distance in this time
GENTLE = 0.2  # m/s^2: tilts the hanging pole by about 1 degree, 0.2 / 9.81 rad

# The gains are for TUNED_MASS and a delay of two periods of 20 ms: half a period of sampling, half a period
# of measuring the speed, and up to one until a motor value acts. The loop
# L(s) = (SPEED_GAIN + SPEED_INTEGRAL / s) exp(-0.04 s) / (TUNED_MASS s) crosses over at 15 rad/s with a phase
# margin of 31 degrees and a gain margin of 2.4: it is stable with a motor twice as strong or a cart half as
# heavy, and friction damps it further. The integral acts within SPEED_GAIN / SPEED_INTEGRAL = 0.15 s, and
# compensates tilt and other friction. A longer period delays more: the gain is scaled by 1 / period and the
# integral by 1 / period squared, which keeps both margins; so does scaling both by the mass.
SPEED_GAIN, SPEED_INTEGRAL = 12.0, 80.0  # N s/m, N/m
TUNED_FOR, TUNED_MASS = 0.02, 0.85  # s, kg

ROLLING_PERIODS, ROLLING = 10, 0.04  # periods, and m in them: 0.2 m/s, a cart that still rolls
LONGEST_ROLLING = 5.0  # s

ROUNDS = 3  # of braking, centring and waiting
LONGEST_BRAKING, LONGEST_CALM = 12.0, 4.0  # s
# degrees
STILL = 1.0  # peak to peak: worth waiting for, up to LONGEST_CALM
NEARLY_STILL = 2.1  # peak to peak: good enough
BRAKED = 2.6  # peak to peak; the cart's friction keeps it from braking smaller swings
SLIPPED = 1.5  # a pole that rests this far off after homing lost its zero
SMALL_SWING = 90.0  # peak to peak: its middle is the hanging pole, ...
WRONG_ZERO = 20.0  # ... which is nearer to the zero than this, or the zero is wrong
LARGE_SWING = 180.0  # peak to peak: no right brake leaves one after LONGEST_BRAKING

FOLLOW = 0.9  # m/s^2 of the cart for 1 rad/s of the pole
HARDEST_FOLLOW = 2.0  # m/s^2 in the middle, ...
FOLLOW_WITHIN = 0.2  # m, ... less away from it, and none from here on
RETURN, DAMPING = 3.0, 2.0  # 1/s^2, 1/s: towards the middle, and against the cart's speed
HARDEST_RETURN = 2.5  # m/s^2
CREEP = 0.002  # m/s; below this a cart counts as standing


class ArmedCart:
    """An armed cart. Every move raises FaultError when it latches a fault. Times by the cart's clock."""

    def __init__(self, cart: SerialCart) -> None:
        self.cart, self.hardware = cart, cart.hardware

    def metres(self, counts: int) -> float:
        """Return cart counts in m."""
        return counts * self.hardware.encoders.metres

    def pole_counts(self, degrees: float) -> int:
        """Return an angle of the pole in counts, at least one."""
        return max(1, self.hardware.encoders.pole_counts(degrees))

    def arm(self) -> State:
        """Arm the motor, at rest."""
        self.cart.start()
        return self.check(self.cart.get_state())

    def drive(self, motor: int) -> State:
        """Apply a motor value for one period; return the state at its end."""
        self.cart.set_motor(motor)
        return self.check(self.cart.get_state())

    def rest(self) -> State:
        """Apply motor 0 until the cart is at rest. Raises NotReadyError if it never does."""
        states, rests = [self.drive(0)], max(2, self.hardware.encoders.cart_counts(RESTS))
        for _ in range(self.periods(LONGEST_REST)):
            states.append(self.drive(0))
            counts = [state.cart_counts for state in states[-self.periods(REST_SECONDS) - 1 :]]
            if len(counts) > self.periods(REST_SECONDS) and spread(counts) <= rests:
                return states[-1]
        raise NotReadyError(
            f"the cart does not come to rest within {LONGEST_REST:g} s with the motor at 0",
            "put the track level, check that the motor driver gives no voltage at 0",
        )

    def calm(self, swing: int, patience: float) -> tuple[list[State], int]:
        """Apply motor 0 until the pole swings by `swing` counts peak to peak or less, within `patience` s.

        Returns the states and the swing that is left. A pole with little friction swings for minutes.
        """
        states = [self.rest()]
        for _ in range(self.periods(max(patience, SWING_SECONDS))):
            states.append(self.drive(0))
            poles = [state.pole_counts for state in states[-self.periods(SWING_SECONDS) - 1 :]]
            if len(poles) > self.periods(SWING_SECONDS) and spread(poles) <= swing:
                break
        return states, spread(poles)

    @property
    def period(self) -> float:
        """Control period in s."""
        return self.cart.information.period_us * 1e-6

    def periods(self, seconds: float) -> int:
        """Return the number of control periods in a time, rounded up."""
        return math.ceil(seconds / self.period)

    def check(self, state: State) -> State:
        """Return the state. Raises FaultError if it has a latched fault."""
        if state.fault:
            raise fault_error(state.fault)
        return state


def gentle_motor(hardware: Hardware) -> int:
    """Return the largest motor value of these moves; from `hard_push` on the cart watches for stalls."""
    return min(hardware.gentle_motor, hardware.hard_push - 1)


def nominal_deadband(hardware: Hardware) -> dict[int, float]:
    """Return the motor values that just move the cart by its file, to the RIGHT and to the LEFT."""
    return dict.fromkeys((RIGHT, LEFT), hardware.breakaway_motor)


def spread(counts: list[int]) -> int:
    """Return the largest minus the smallest count."""
    return max(counts) - min(counts)


@dataclass
class Centring:
    """The controller of one way back to the middle."""

    hardware: Hardware
    period: float  # s
    deadband: Mapping[int, float]  # motor values that just move the cart, to the RIGHT and to the LEFT
    slowest: float = 0.0  # m/s
    planned: float = 0.0  # m/s
    integral: float = 0.0  # N

    def motor(self, before: State, state: State) -> int:
        """Return the next motor value from the last two states."""
        passed, metres = seconds_between(before.time_us, state.time_us), self.hardware.encoders.metres
        away = -metres * state.cart_counts
        target = math.copysign(max(self.slowest, min(TRAVEL_SPEED, abs(away) / SLOWING)), away)
        self.planned += within(GENTLE * passed, target - self.planned)
        lag = self.planned - metres * (state.cart_counts - before.cart_counts) / passed
        share, mass = min(1.0, TUNED_FOR / self.period), self.hardware.moving_mass / TUNED_MASS
        integral = self.integral + share**2 * mass * SPEED_INTEGRAL * lag * passed
        self.integral = within(self.hardware.gentle_force, integral)
        force = self._friction() + share * mass * SPEED_GAIN * lag + self.integral
        return rough_motor(force, self.hardware, self.deadband)

    def _friction(self) -> float:
        """Force in N that the friction needs in the planned direction."""
        if not self.planned:
            return 0.0
        side = RIGHT if self.planned > 0 else LEFT
        offset = motor_offset(self.hardware, self.deadband, side)
        return side * (self.deadband[side] - offset) / self.hardware.motor_per_newton


def centre(
    moves: ArmedCart,
    deadband: Mapping[int, float] | None = None,
    tolerance: float = CENTRED,
    slowest: float = 0.0,
) -> None:
    """Move the cart to within `tolerance` m of the middle, at least `slowest` m/s fast.

    Without a `deadband` it is the nominal one. Raises NotReadyError if it does not get there, or if its count
    does not show its motion.
    """
    known = nominal_deadband(moves.hardware) if deadband is None else deadband
    controller = Centring(moves.hardware, moves.period, known, slowest)
    blind = BlindMotion(moves.hardware, SURELY * max(*known.values(), moves.hardware.breakaway_motor))
    before = moves.drive(0)
    state = moves.drive(0)
    for _ in range(moves.periods(LONGEST_CENTRING)):
        if abs(moves.metres(state.cart_counts)) < tolerance:
            return
        motor = controller.motor(before, state)
        before, state = state, moves.drive(motor)
        if blind.is_seen(motor, state.cart_counts, moves.period):
            remedy = f"{NO_MOTION}; if it moves freely, its file gives too little friction: cartpole-identify"
            raise NotReadyError(UNSEEN_MOTION, remedy)
    raise NotReadyError(
        "the cart does not come back to the middle; it is "
        f"{moves.metres(state.cart_counts) * 1e3:+.0f} mm off",
        "free the cart, put the track level",
    )


def rough_motor(force: float, hardware: Hardware, deadband: Mapping[int, float]) -> int:
    """Return the motor value for about a force in N, at most `gentle_motor`."""
    if abs(force) < SMALLEST_FORCE:
        return 0
    side = RIGHT if force > 0 else LEFT
    motor = side * motor_offset(hardware, deadband, side) + hardware.motor_per_newton * force
    return round(within(gentle_motor(hardware), motor))


def motor_offset(hardware: Hardware, deadband: Mapping[int, float], side: int) -> float:
    """Return the motor value at which the force to a side starts, at most the nominal one.

    It falls to 0 with the dead-band: a jump of the motor value where the force changes its sign rattles.
    """
    missing = nominal_deadband(hardware)[side] - deadband[side]
    return max(0.0, min(hardware.motor_offset, hardware.motor_offset - 2 * missing))


def within(limit: float, value: float) -> float:
    """Return `value`, limited to -limit to limit."""
    return max(-limit, min(limit, value))


@waiting("re-centring", thread=False)
def recentre(cart: SerialCart, hanging: int) -> None:
    """Bring the cart to the middle, its pole to rest, and disarm it.

    `hanging` is the pole's count at rest after homing. Raises NotReadyError if the cart has to be homed: it
    is at the end of the track, does not come to rest in the middle, or its pole does not rest where it did
    after homing. Raises FaultError and LinkError as the cart's own methods do.
    """
    stop_rolling(cart)
    moves = ArmedCart(cart)
    with cart.unmeasured():
        try:
            moves.arm()
            settled = settle(moves)
        finally:
            with suppress(PlantError):  # an error on its way says more; the watchdog stops the cart
                cart.stop()
    turn = cart.information.pole_counts_per_turn
    off = math.remainder(settled - hanging, turn)
    if abs(off) > moves.pole_counts(SLIPPED):
        raise NotReadyError(
            f"the pole rests {off * 360 / turn:+.1f} deg from where it did after homing",
            "check the coupling of its encoder",
        )


def stop_rolling(cart: SerialCart) -> None:
    """Wait, disarmed, until the cart is slow. Raises NotReadyError if it is beyond the hard limit then.

    It need not stand still: a pole that swings far moves it.
    """
    newest = cart.poll_state()
    counts, began = [newest.cart_counts], newest.time_us
    metres = cart.hardware.encoders.metres
    while len(counts) <= ROLLING_PERIODS or metres * spread(counts[-ROLLING_PERIODS - 1 :]) > ROLLING:
        newest = cart.poll_state()
        counts.append(newest.cart_counts)
        if seconds_between(began, newest.time_us) > LONGEST_ROLLING:
            raise NotReadyError("the cart keeps rolling with its motor off", "put the track level")
    if abs(newest.cart_counts) >= cart.information.hard_limit_counts:
        raise NotReadyError("the cart stands at the end of the track", "home it")


def settle(moves: ArmedCart) -> float:
    """Brake, centre and wait until the pole is still; return the pole count at which it hangs.

    Raises NotReadyError if it keeps swinging.
    """
    for _ in range(ROUNDS):
        brake(moves)
        centre(moves)
        states, swing = moves.calm(moves.pole_counts(STILL), LONGEST_CALM)
        if swing <= moves.pole_counts(NEARLY_STILL):
            last = [state.pole_counts for state in states[-moves.periods(SWING_SECONDS) :]]
            return (max(last) + min(last)) / 2
    raise NotReadyError(f"the pole still swings by {swing} counts", "keep hands and drafts off it")


def brake(moves: ArmedCart) -> None:
    """Take most of the swing out of the pole by moving the cart; stop trying after LONGEST_BRAKING.

    A cart that follows its hanging pole, and moves the other way while the pole is above it, takes energy
    out of any swing, whole turns included. By a wrong zero it would add energy: raises NotReadyError if the
    zero is seen to be wrong, or if the pole swings far after all.
    """
    turn = moves.cart.information.pole_counts_per_turn
    braked, small, wrong, large = map(moves.pole_counts, (BRAKED, SMALL_SWING, WRONG_ZERO, LARGE_SWING))
    blind = BlindMotion(moves.hardware, LIKELY * moves.hardware.breakaway_motor)
    before = moves.drive(0)
    state, poles = moves.drive(0), [before.pole_counts]
    for _ in range(moves.periods(LONGEST_BRAKING)):
        poles.append(state.pole_counts)
        last = poles[-moves.periods(SWING_SECONDS) - 1 :]
        if len(last) > moves.periods(SWING_SECONDS):
            if spread(last) <= braked:
                return
            off = math.remainder((max(last) + min(last)) / 2 - turn / 2, turn)
            if spread(last) < small and abs(off) > wrong:
                raise NotReadyError(
                    f"the pole swings about a point {off * 360 / turn:+.0f} deg from its zero",
                    "check the coupling of its encoder",
                )
        motor = braking_motor(moves.hardware, before, state)
        before, state = state, moves.drive(motor)
        if blind.is_seen(motor, state.cart_counts, moves.period):
            return  # friction holds the cart, or its count is dead: `centre` pushes harder, and knows
    if spread(poles[-moves.periods(SWING_SECONDS) - 1 :]) > large:
        raise NotReadyError(
            f"the pole still swings far after {LONGEST_BRAKING:g} s of braking", "check the pole's encoder"
        )


def braking_motor(hardware: Hardware, before: State, state: State) -> int:
    """Return a motor value that brakes the pole and draws the cart to the middle."""
    passed = seconds_between(before.time_us, state.time_us)
    metres, radians = hardware.encoders.metres, hardware.encoders.radians
    x, x_dot = metres * state.cart_counts, metres * (state.cart_counts - before.cart_counts) / passed
    swing = state.pole_counts * radians - math.pi  # from hanging
    swing_dot = (state.pole_counts - before.pole_counts) * radians / passed
    room = HARDEST_FOLLOW * max(0.0, 1 - abs(x) / FOLLOW_WITHIN)
    follow = within(room, -FOLLOW * swing_dot * math.cos(swing))
    target = follow + within(HARDEST_RETURN, -RETURN * x - DAMPING * x_dot)
    direction = x_dot if abs(x_dot) > CREEP else target
    force = hardware.moving_mass * target + math.copysign(hardware.moving_friction, direction)
    return rough_motor(force, hardware, nominal_deadband(hardware))
