"""The emulated cart seen from outside: firmware, physics, encoders and a person's hand, period by period."""

import math
import random

from cartpole_rl.emulator.firmware import Firmware
from cartpole_rl.emulator.homing import CART_METRES, POLE_RADIANS
from cartpole_rl.emulator.physics import CartPhysics
from cartpole_rl.emulator.settings import EmulatorSettings

FARTHEST_BOOT = 0.3  # share of the half length: the cart wakes up this near to the middle
HAND_ERROR = 0.03  # rad: how near to upright a hand holds the pole


class CartDevice:
    """A cart just switched on, somewhere on its track, the pole hanging. Time passes only when told to."""

    def __init__(self, settings: EmulatorSettings) -> None:
        """Raises EmulatorError where MuJoCo is not installed."""
        self._settings = settings
        self.physics = CartPhysics(settings)
        self._latencies = random.Random(f"latency {settings.seed}")
        self._people = random.Random(f"people {settings.seed}")
        self._held: float | None = None  # rad, where the hand holds the pole
        self.now_us = 0
        self.physics.place(
            settings.track_half_length * self._people.uniform(-FARTHEST_BOOT, FARTHEST_BOOT), math.pi
        )
        self._boot = (0, 0)
        self._boot = self._counts()
        self.firmware = Firmware(self._latency_us, round(settings.angle_offset / POLE_RADIANS))

    def receive(self, stuffed: bytes, now_us: int) -> list[bytes]:
        """Give the cart a frame that arrived at a time, which is not before `now_us`; returns its answer."""
        return self.firmware.receive(stuffed, now_us)

    @property
    def period_end_us(self) -> int:
        """When the period ends that begins now."""
        return self.now_us + self.firmware.period_us

    def pass_period(self, end_us: int) -> list[bytes]:
        """Let the time until `end_us` pass as one period; returns the frames sent at its end, STATE last."""
        self._move_hand()
        values = self.firmware.drive(self.now_us, end_us)
        for (since, motor), (until, _) in zip(values, [*values[1:], (end_us, 0)], strict=True):
            self.physics.advance(motor, (until - since) / 1e6)
        if self._held is not None:
            self.physics.place_pole(self._held)
        self.now_us = end_us
        frames = self.firmware.tick(end_us, *self._counts())
        self._move_hand()
        return frames

    def _counts(self) -> tuple[int, int]:
        """Raw counts of cart and pole since boot; a count changes where a line of the disc passes.

        The pole's disc sits so that its lines carry the part of `angle_offset` below a count; the firmware's
        zero, a whole number, carries the rest.
        """
        cart = math.floor(self.physics.x / CART_METRES)
        pole = math.floor((self.physics.angle + self._settings.angle_offset) / POLE_RADIANS + 0.5)
        return cart - self._boot[0], pole - self._boot[1]

    def _latency_us(self) -> int:
        jitter = self._settings.latency_jitter
        return round(max(0.0, self._settings.latency + self._latencies.uniform(-jitter, jitter)) * 1e6)

    def _move_hand(self) -> None:
        """Where `start` is upright: hold the pole up while the cart is homed and disarmed, else let go."""
        if self._settings.start != "upright":
            return
        firmware = self.firmware
        wanted = firmware.homed and not firmware.armed
        if wanted and self._held is None:
            self._held = nearest_upright(self.physics.angle) + self._people.uniform(-HAND_ERROR, HAND_ERROR)
            self.physics.place_pole(self._held)
        elif not wanted and self._held is not None:
            if firmware.homing:
                self.physics.place_pole(nearest_upright(self.physics.angle) + math.pi)
            self._held = None


def nearest_upright(angle: float) -> float:
    """The upright angle to which a hand lifts the pole; one that hangs near pi goes to 0, not to two pi."""
    return 2 * math.pi * round((angle - 0.5) / (2 * math.pi))
