"""A rough cart and pole: a firmware under test homes, drives and fails with it as with a real one."""

import math
import random

from cartpole_rl.rig.hardware import Hardware

GRAVITY, LENGTH = 9.81, 0.24  # m/s^2 and m, of the pole as a pendulum
STEP = 1e-3  # s, longest step
PRESSED = 0.005  # m before a stop, an end switch is pressed


class ToyCart:
    """A cart on a track with stops, and a pendulum. Some tracks are too short or too long."""

    def __init__(self, dice: random.Random, rig: Hardware) -> None:
        self._dice, self._rig = dice, rig
        self._half = rig.half_span * (1.0 if dice.random() < 0.8 else dice.uniform(0.93, 1.06))  # m
        self._x, self._v = rig.half_span * dice.uniform(-0.7, 0.7), 0.0
        self._swing, self._rate = dice.uniform(-0.6, 0.6), dice.uniform(-1.0, 1.0)  # rad from hanging
        self._damping = dice.choice([0.05, 0.3, 3.0])  # 1/s
        self._origin = self._counts()
        self._frozen: dict[str, int] = {}
        self._jammed = False
        self._stuck: tuple[bool, bool] | None = None  # both switches, whatever the cart does

    def advance(self, motor: int, us: int) -> None:
        """Move for `us` under one motor value."""
        steps = max(1, math.ceil(us / 1e6 / STEP))
        step = us / 1e6 / steps
        rig = self._rig
        force = math.copysign(max(0.0, (abs(motor) - rig.motor_offset) / rig.motor_per_newton), motor)
        dry = 1.1 * rig.moving_friction  # N
        for _ in range(steps):
            friction = dry if abs(self._v) > 1e-3 or abs(force) > dry else 0.0
            pull = force - math.copysign(friction, self._v if abs(self._v) > 1e-3 else force)
            acceleration = (pull - 0.6 * self._v) / rig.moving_mass if friction else 0.0
            self._v = self._v + acceleration * step if friction else 0.0
            self._x += 0.0 if self._jammed else self._v * step
            if abs(self._x) > self._half:
                self._x, self._v = math.copysign(self._half, self._x), 0.0
            torque = -GRAVITY * math.sin(self._swing) - acceleration * math.cos(self._swing)
            self._rate += (torque / LENGTH - self._damping * self._rate) * step
            self._swing += self._rate * step

    def counts(self) -> tuple[int, int]:
        """Return the raw counts of cart and pole since the start."""
        cart, pole = (now - then for now, then in zip(self._counts(), self._origin, strict=True))
        return self._frozen.get("cart", cart), self._frozen.get("pole", pole)

    def switches(self) -> int:
        """Return the end switches that are pressed, a little before the stops."""
        left, right = self._stuck or (side * self._x > self._half - PRESSED for side in (-1, 1))
        return left + 2 * right

    def maybe_fail(self, share: float) -> None:
        """With a small chance, freeze an encoder or the switches, jam or throw the cart, or turn the pole."""
        if self._dice.random() >= share:
            return
        cart, pole = self.counts()
        match self._dice.randrange(7):
            case 0:
                self._frozen["cart"] = cart
            case 1:
                self._frozen["pole"] = pole
            case 2:
                self._frozen.clear()
            case 3:
                self._jammed = True
            case 4:
                self._x = self._dice.uniform(-self._half, self._half)
            case 5:
                self._stuck = self._dice.choice([(False, True), (True, False), (True, True)])
            case _:
                self._rate += self._dice.uniform(-30, 30)

    def repair(self) -> None:
        """Free the encoders, the switches and the cart, and put the cart near the middle."""
        self._frozen.clear()
        self._jammed, self._stuck = False, None
        self._x, self._v = self._half * self._dice.uniform(-0.25, 0.25), 0.0

    def _counts(self) -> tuple[int, int]:
        metres, turn = self._rig.encoders
        return math.floor(self._x / metres), math.floor(self._swing / math.tau * turn)
