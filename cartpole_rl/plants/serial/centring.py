"""The controller that brings an armed cart to the middle of the track, and the rough motor model behind it.

The cart follows a planned speed that slows down towards the middle and changes so gently that the pole hardly
swings. A PI controller turns the lag behind that speed into a force; friction is added as a feedforward, and
the inverse of the motor curve turns the force into a motor value. All of it stays below the motor values for
which the cart watches for stalls.

The model is that of the nominal cart. The motor value that its friction needs may be known better: the
preflight measures the dead-band of each side, the re-centring between episodes uses the nominal one. A
dead-band below the nominal one is taken as friction with a smaller offset: an offset larger than the
dead-band would drive the cart the wrong way. The
moves in `identification.experiments` do not use this controller: they are fast on purpose, as part of what is
recorded, and work on any plant.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.moves import GENTLE_MOTOR, ArmedCart, metres
from cartpole_rl.wire import State, seconds_between

CENTRED = 0.002  # m; an episode starts no farther from the middle
LONGEST_CENTRING = 15.0  # s

MASS = 0.85  # kg, cart and pole
FRICTION = 0.5  # N; too much rather than too little: a cart that overcomes its friction can be controlled
MOTOR_OFFSET, MOTOR_PER_NEWTON = 50, 50.0  # motor value at which the force starts, and that a newton adds
SMALLEST_FORCE = 0.02  # N; below this the motor is off
RIGHT, LEFT = 1, -1
NOMINAL_DEADBAND: dict[int, float] = dict.fromkeys((RIGHT, LEFT), MOTOR_OFFSET + MOTOR_PER_NEWTON * FRICTION)

TRAVEL_SPEED = 0.2  # m/s
SLOWING = 1.0  # s: the speed is what would cover the remaining distance in this time
GENTLE = 0.2  # m/s^2: tilts the hanging pole by about 1 degree, 0.2 / 9.81 rad

# The gains are for a nominal cart and a delay of two periods of 20 ms: half a period of sampling, half a
# period of measuring the speed, and up to one until a motor value acts. The loop
# L(s) = (SPEED_GAIN + SPEED_INTEGRAL / s) exp(-0.04 s) / (MASS s) then crosses over at 15 rad/s, with a phase
# margin of 31 degrees and a gain margin of 2.4: it is stable with a motor twice as strong or a cart half as
# heavy, and friction damps it further. The integral acts within SPEED_GAIN / SPEED_INTEGRAL = 0.15 s, and
# compensates tilt and other friction. A longer period delays more: the gain is scaled by 1 / period and the
# integral by 1 / period squared, which keeps both margins.
SPEED_GAIN, SPEED_INTEGRAL = 12.0, 80.0  # N s/m, N/m
TUNED_FOR = 0.02  # s
LARGEST_PUSH = 3.0  # N of the integral: what `GENTLE_MOTOR` gives


@dataclass
class Centring:
    """The controller of one way back to the middle."""

    period: float  # s
    deadband: Mapping[int, float]  # motor values that just move the cart, to the RIGHT and to the LEFT
    slowest: float = 0.0  # m/s
    planned: float = 0.0  # m/s
    integral: float = 0.0  # N

    def motor(self, before: State, state: State) -> int:
        """Return the next motor value from the last two states."""
        passed = interval(before, state)
        away = -metres(state.cart_counts)
        target = math.copysign(max(self.slowest, min(TRAVEL_SPEED, abs(away) / SLOWING)), away)
        self.planned += within(GENTLE * passed, target - self.planned)
        lag = self.planned - metres(state.cart_counts - before.cart_counts) / passed
        share = min(1.0, TUNED_FOR / self.period)
        self.integral = within(LARGEST_PUSH, self.integral + share**2 * SPEED_INTEGRAL * lag * passed)
        return rough_motor(self._friction() + share * SPEED_GAIN * lag + self.integral, self.deadband)

    def _friction(self) -> float:
        """Force in N that the friction needs in the planned direction."""
        if not self.planned:
            return 0.0
        side = RIGHT if self.planned > 0 else LEFT
        return side * (self.deadband[side] - motor_offset(self.deadband, side)) / MOTOR_PER_NEWTON


def centre(
    moves: ArmedCart,
    deadband: Mapping[int, float] = NOMINAL_DEADBAND,
    tolerance: float = CENTRED,
    slowest: float = 0.0,
) -> None:
    """Move the cart to within `tolerance` m of the middle, at least `slowest` m/s fast.

    Raises NotReadyError if it does not get there.
    """
    controller = Centring(moves.period, deadband, slowest)
    before = moves.drive(0)
    state = moves.drive(0)
    for _ in range(moves.periods(LONGEST_CENTRING)):
        if abs(metres(state.cart_counts)) < tolerance:
            return
        before, state = state, moves.drive(controller.motor(before, state))
    raise NotReadyError(
        f"the cart does not come back to the middle; it is {metres(state.cart_counts) * 1e3:+.0f} mm off",
        "free the cart, put the track level",
    )


def rough_motor(force: float, deadband: Mapping[int, float] = NOMINAL_DEADBAND) -> int:
    """Return the motor value for about a force in N, at most `GENTLE_MOTOR`."""
    if abs(force) < SMALLEST_FORCE:
        return 0
    side = RIGHT if force > 0 else LEFT
    return round(within(GENTLE_MOTOR, side * motor_offset(deadband, side) + MOTOR_PER_NEWTON * force))


def motor_offset(deadband: Mapping[int, float], side: int) -> float:
    """Return the motor value at which the force to a side starts, at most the nominal one.

    It falls to 0 with the dead-band: a jump of the motor value where the force changes its sign rattles.
    """
    return max(0.0, min(MOTOR_OFFSET, MOTOR_OFFSET - 2 * (NOMINAL_DEADBAND[side] - deadband[side])))


def interval(before: State, state: State) -> float:
    """Return the seconds between two states by the cart's clock."""
    return seconds_between(before.time_us, state.time_us)


def within(limit: float, value: float) -> float:
    """Return `value`, limited to -limit to limit."""
    return max(-limit, min(limit, value))
