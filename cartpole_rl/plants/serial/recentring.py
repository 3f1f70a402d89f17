"""Brings a homed cart back to the middle and its pole to rest, between episodes. Homing takes far longer.

The cart brakes the pole's swing by following it, is then moved to the middle, and let go until the pole
hangs still; what the move left of a swing is braked once more. Motor values stay below those that a stall is
watched for, and all of the cart's own rules hold, as it is armed. The cart is known only roughly here (its
nominal motor curve, mass and friction), so that this works for any cart near enough to the nominal one.

Signs as in `preflight`: a hanging pole's count grows when the cart speeds up to the right.
"""

import math
from contextlib import suppress

from cartpole_rl.errors import PlantError
from cartpole_rl.physics.encoders import POLE_RADIANS_PER_COUNT
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.moves import (
    GENTLE_MOTOR,
    SWING_SECONDS,
    ArmedCart,
    metres,
    spread,
)
from cartpole_rl.wire import State, seconds_between

ROLLING_PERIODS, ROLLING = 10, 0.04  # m in so many periods, 0.2 m/s: a cart that still rolls
LONGEST_ROLLING = 5.0  # s

ROUNDS = 3  # of braking, centring and waiting
LONGEST_BRAKING, LONGEST_CENTRING, LONGEST_CALM = 12.0, 15.0, 4.0  # s
STILL = 11  # pole counts peak to peak, 1 degree: worth waiting for, for as long as above
NEARLY_STILL = 24  # pole counts peak to peak: a swing of 1 degree to each side, which is good enough
BRAKED = 30  # pole counts peak to peak; the cart's friction is in the way of braking smaller swings
CENTRED = 0.002  # m
SLIPPED = 17  # pole counts, 1.5 degrees: a pole that rests so far from where it did has lost its zero

MASS = 0.85  # kg, cart and pole
FRICTION = 0.5  # N; too much rather than too little: the cart has to move before the pole is braked
MOTOR_OFFSET, MOTOR_A_NEWTON = 50, 50.0  # motor value at which the force begins, and what a newton adds
SMALLEST_FORCE = 0.02  # N; below this the motor is off

FOLLOW = 0.9  # m/s^2 of the cart for 1 rad/s of the pole
HARDEST_FOLLOW = 2.0  # m/s^2 in the middle, ...
FOLLOW_WITHIN = 0.2  # m, ... less away from it, and none from here on
RETURN, DAMPING = 3.0, 2.0  # 1/s^2, 1/s: towards the middle, and against the cart's speed
HARDEST_RETURN = 2.5  # m/s^2
CREEP = 0.002  # m/s; below this a cart counts as standing

TRAVEL_SPEED = 0.2  # m/s
SLOWING = 1.0  # s: the speed is what would cover the way that is left in so long
GENTLE = 0.2  # m/s^2: changes of speed that leave the pole nearly still
SPEED_GAIN, SPEED_INTEGRAL = 12.0, 80.0  # N s/m, N/m, for periods up to ...
TUNED_FOR = 0.02  # s; a longer one cannot bear them
LARGEST_PUSH = 3.0  # N


def recentre(cart: SerialCart, hanging: int) -> None:
    """Bring the cart to the middle, its pole to rest, and disarm it.

    `hanging` is the pole's count at rest after homing. Raises NotReadyError, saying what is off, where homing
    is called for: the cart is too near a stop, does not come to rest in the middle, or its pole rests
    elsewhere than after homing. Raises FaultError and LinkError as the cart's own methods do.
    """
    stop_rolling(cart)
    moves = ArmedCart(cart)
    with cart.unmeasured():
        try:
            moves.arm()
            settled = settle(moves)
        finally:
            with suppress(PlantError):  # what is raised already says more; the watchdog stops the cart
                cart.stop()
    turn = cart.information.pole_counts_per_turn
    off = math.remainder(settled - hanging, turn)
    if abs(off) > SLIPPED:
        raise NotReadyError(
            f"the pole rests {off * 360 / turn:+.1f} deg from where it did after homing",
            "check how its encoder is coupled to it",
        )


def stop_rolling(cart: SerialCart) -> None:
    """Wait, disarmed, until the cart is slow. Raises NotReadyError if it is within the hard limit then.

    It need not stand: a pole that swings far moves it.
    """
    newest = cart.poll_state()
    counts, began = [newest.cart_counts], newest.time_us
    while len(counts) <= ROLLING_PERIODS or metres(spread(counts[-ROLLING_PERIODS - 1 :])) > ROLLING:
        newest = cart.poll_state()
        counts.append(newest.cart_counts)
        if seconds_between(began, newest.time_us) > LONGEST_ROLLING:
            raise NotReadyError("the cart rolls on with its motor off", "put the track level")
    if abs(newest.cart_counts) >= cart.information.hard_limit_counts:
        raise NotReadyError("the cart stands at the end of the track", "home it")


def settle(moves: ArmedCart) -> float:
    """Brake, centre and wait, until the pole is still; the pole count at which it is.

    Raises NotReadyError if it never is.
    """
    for _ in range(ROUNDS):
        brake(moves)
        centre(moves)
        states, swing = moves.calm(STILL, LONGEST_CALM)
        if swing <= NEARLY_STILL:
            last = [state.pole_counts for state in states[-moves.periods(SWING_SECONDS) :]]
            return (max(last) + min(last)) / 2
    raise NotReadyError(f"the pole still swings by {swing} counts", "keep hands and drafts off it")


def brake(moves: ArmedCart) -> None:
    """Take the swing out of the pole, or most of it, by moving the cart about the middle.

    A cart that follows its hanging pole, and is pushed the other way while the pole is above it, takes energy
    out of any swing, whole turns included. After LONGEST_BRAKING what is left is left.
    """
    before = moves.drive(0)
    state, poles = moves.drive(0), [before.pole_counts]
    for _ in range(moves.periods(LONGEST_BRAKING)):
        poles.append(state.pole_counts)
        last = poles[-moves.periods(SWING_SECONDS) - 1 :]
        if len(last) > moves.periods(SWING_SECONDS) and spread(last) <= BRAKED:
            return
        before, state = state, moves.drive(braking_motor(before, state))


def braking_motor(before: State, state: State) -> int:
    """Motor value that brakes the pole's swing and draws the cart to the middle, from the last two states."""
    passed = interval(before, state)
    x, x_dot = metres(state.cart_counts), metres(state.cart_counts - before.cart_counts) / passed
    swing = state.pole_counts * POLE_RADIANS_PER_COUNT - math.pi  # from hanging
    swing_dot = (state.pole_counts - before.pole_counts) * POLE_RADIANS_PER_COUNT / passed
    room = HARDEST_FOLLOW * max(0.0, 1 - abs(x) / FOLLOW_WITHIN)
    follow = within(room, -FOLLOW * swing_dot * math.cos(swing))
    wanted = follow + within(HARDEST_RETURN, -RETURN * x - DAMPING * x_dot)
    return rough_motor(MASS * wanted + math.copysign(FRICTION, x_dot if abs(x_dot) > CREEP else wanted))


def centre(moves: ArmedCart) -> None:
    """Move to the middle so gently that the pole hardly swings. Raises NotReadyError if that fails.

    PI on the measured speed, rough friction added.
    """
    before = moves.drive(0)
    state, planned, integral = moves.drive(0), 0.0, 0.0  # planned speed, m/s; N
    share = min(1.0, TUNED_FOR / moves.period)
    for _ in range(moves.periods(LONGEST_CENTRING)):
        away = -metres(state.cart_counts)
        if abs(away) < CENTRED:
            return
        passed = interval(before, state)
        planned += within(GENTLE * passed, within(TRAVEL_SPEED, away / SLOWING) - planned)
        lag = planned - metres(state.cart_counts - before.cart_counts) / passed
        integral = within(LARGEST_PUSH, integral + share * SPEED_INTEGRAL * lag * passed)
        friction = math.copysign(FRICTION, planned) if planned else 0.0
        before, state = state, moves.drive(rough_motor(friction + share * SPEED_GAIN * lag + integral))
    raise NotReadyError(
        f"the cart does not come back to the middle; it is {metres(state.cart_counts) * 1e3:+.0f} mm off",
        "free the cart, put the track level",
    )


def rough_motor(force: float) -> int:
    """Motor value for about a force in N, within what is gentle."""
    if abs(force) < SMALLEST_FORCE:
        return 0
    return round(within(GENTLE_MOTOR, math.copysign(MOTOR_OFFSET, force) + MOTOR_A_NEWTON * force))


def interval(before: State, state: State) -> float:
    """Seconds between two states by the cart's clock."""
    return seconds_between(before.time_us, state.time_us)


def within(limit: float, value: float) -> float:
    """`value`, no further from 0 than `limit`."""
    return max(-limit, min(limit, value))
