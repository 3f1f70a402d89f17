"""The firmware's slow motions: a speed servo and a brake for the swinging pole.

Both use only rough numbers of the cart (nominal motor curve, mass and friction), as firmware does.
SI units; positive to the right.
"""

import math

MASS = 0.85  # kg, cart and pole
FRICTION = 0.5  # N
PUSH = 3.0  # N, largest force of these motions
NEGLIGIBLE = 0.02  # N, below which the motor stays off
MOTOR_OFFSET = 50  # motor value at which the force starts
MOTOR_PER_NEWTON = 50
GENTLE = 0.2  # m/s^2, an acceleration that leaves the pole nearly still


def rough_motor(force: float) -> int:
    """Return the motor value for a force in N, roughly: a line with an offset."""
    if abs(force) < NEGLIGIBLE:
        return 0
    return int(math.copysign(MOTOR_OFFSET + MOTOR_PER_NEWTON * min(abs(force), PUSH), force))


class SpeedServo:
    """PI control of the cart's speed with rough friction compensation; the target changes gently."""

    PROPORTIONAL = 12.0  # N s/m
    INTEGRAL = 80.0  # N/m
    TUNED_FOR = 0.02  # s, the period for these gains; a longer one needs smaller gains

    def __init__(self) -> None:
        self._reference = 0.0  # m/s, follows the target at GENTLE
        self._integral = 0.0  # N

    def motor(self, target: float, speed: float, seconds: float) -> int:
        """Return the motor value for the next `seconds`; target and measured speed in m/s."""
        change = GENTLE * seconds
        self._reference += max(-change, min(change, target - self._reference))
        error = self._reference - speed
        share = min(1.0, self.TUNED_FOR / seconds)
        integral = self._integral + share * self.INTEGRAL * error * seconds
        self._integral = max(-PUSH, min(PUSH, integral))
        ahead = math.copysign(FRICTION, self._reference) if self._reference else 0.0
        return rough_motor(ahead + share * self.PROPORTIONAL * error + self._integral)


class SwingBrake:
    """Brakes the swing of a hanging pole: the cart follows the pole and is pulled back to the middle."""

    FOLLOW = 0.9  # m/s^2 of the cart for 1 rad/s of the pole
    RETURN = 3.0  # 1/s^2
    DAMPING = 2.0  # 1/s
    HARDEST = 2.5  # m/s^2
    STANDS = 0.002  # m/s, a speed up to which the cart counts as standing

    def motor(self, x: float, x_dot: float, swing: float, swing_dot: float) -> int:
        """Return the motor value; x in m from the middle, swing in rad from hanging, signed as the angle."""
        acceleration = -self.FOLLOW * swing_dot * math.cos(swing) - self.RETURN * x - self.DAMPING * x_dot
        acceleration = max(-self.HARDEST, min(self.HARDEST, acceleration))
        moving = x_dot if abs(x_dot) > self.STANDS else acceleration
        return rough_motor(MASS * acceleration + math.copysign(FRICTION, moving))
