"""Bring a homed cart back to the middle and its pole to rest, between episodes. Homing takes far longer.

The cart brakes the pole's swing by following it, moves to the middle, and stands until the pole hangs still;
a swing that is left after that is braked again. Motor values stay below those for which the cart watches for
stalls. The cart is armed, so all of its own limits hold. Only nominal values of the cart are known here
(motor curve, mass and friction); that is enough for any cart that is roughly like the nominal one.

Signs as in `checks.py`: a hanging pole's count grows when the cart accelerates to the right.
"""

import math
from contextlib import suppress

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.centring import FRICTION, MASS, centre, interval, rough_motor, within
from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.moves import SWING_SECONDS, ArmedCart, metres, spread
from cartpole_rl.rig.hardware import POLE_RADIANS_PER_COUNT, pole_counts
from cartpole_rl.wire import State, seconds_between

ROLLING_PERIODS, ROLLING = 10, 0.04  # periods, and m in them: 0.2 m/s, a cart that still rolls
LONGEST_ROLLING = 5.0  # s

ROUNDS = 3  # of braking, centring and waiting
LONGEST_BRAKING, LONGEST_CALM = 12.0, 4.0  # s
STILL = pole_counts(1.0)  # peak to peak: worth waiting for, up to LONGEST_CALM
NEARLY_STILL = pole_counts(2.1)  # peak to peak: good enough
BRAKED = pole_counts(2.6)  # peak to peak; the cart's friction keeps it from braking smaller swings
SLIPPED = pole_counts(1.5)  # a pole that rests this far off after homing lost its zero
SMALL_SWING = pole_counts(90.0)  # peak to peak: its middle is the hanging pole, ...
WRONG_ZERO = pole_counts(20.0)  # ... which is nearer to the zero than this, or the zero is wrong
LARGE_SWING = pole_counts(180.0)  # peak to peak: no right brake leaves one after LONGEST_BRAKING

FOLLOW = 0.9  # m/s^2 of the cart for 1 rad/s of the pole
HARDEST_FOLLOW = 2.0  # m/s^2 in the middle, ...
FOLLOW_WITHIN = 0.2  # m, ... less away from it, and none from here on
RETURN, DAMPING = 3.0, 2.0  # 1/s^2, 1/s: towards the middle, and against the cart's speed
HARDEST_RETURN = 2.5  # m/s^2
CREEP = 0.002  # m/s; below this a cart counts as standing


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
    if abs(off) > SLIPPED:
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
    while len(counts) <= ROLLING_PERIODS or metres(spread(counts[-ROLLING_PERIODS - 1 :])) > ROLLING:
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
        states, swing = moves.calm(STILL, LONGEST_CALM)
        if swing <= NEARLY_STILL:
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
    before = moves.drive(0)
    state, poles = moves.drive(0), [before.pole_counts]
    for _ in range(moves.periods(LONGEST_BRAKING)):
        poles.append(state.pole_counts)
        last = poles[-moves.periods(SWING_SECONDS) - 1 :]
        if len(last) > moves.periods(SWING_SECONDS):
            if spread(last) <= BRAKED:
                return
            off = math.remainder((max(last) + min(last)) / 2 - turn / 2, turn)
            if spread(last) < SMALL_SWING and abs(off) > WRONG_ZERO:
                raise NotReadyError(
                    f"the pole swings about a point {off * 360 / turn:+.0f} deg from its zero",
                    "check the coupling of its encoder",
                )
        before, state = state, moves.drive(braking_motor(before, state))
    if spread(poles[-moves.periods(SWING_SECONDS) - 1 :]) > LARGE_SWING:
        raise NotReadyError(
            f"the pole still swings far after {LONGEST_BRAKING:g} s of braking", "check the pole's encoder"
        )


def braking_motor(before: State, state: State) -> int:
    """Return a motor value that brakes the pole and draws the cart to the middle."""
    passed = interval(before, state)
    x, x_dot = metres(state.cart_counts), metres(state.cart_counts - before.cart_counts) / passed
    swing = state.pole_counts * POLE_RADIANS_PER_COUNT - math.pi  # from hanging
    swing_dot = (state.pole_counts - before.pole_counts) * POLE_RADIANS_PER_COUNT / passed
    room = HARDEST_FOLLOW * max(0.0, 1 - abs(x) / FOLLOW_WITHIN)
    follow = within(room, -FOLLOW * swing_dot * math.cos(swing))
    target = follow + within(HARDEST_RETURN, -RETURN * x - DAMPING * x_dot)
    direction = x_dot if abs(x_dot) > CREEP else target
    return rough_motor(MASS * target + math.copysign(FRICTION, direction))
