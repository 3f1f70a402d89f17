"""An emulated cart without a process or a wire, and a changed value of each of its physical settings."""

import copy
import ctypes
import functools
import math

import pytest
from firmwares import UnderTest, answering, truth

from cartpole_rl.emulator.c_firmware import CFirmware
from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.wire.frames import decode_frame, encode_frame
from cartpole_rl.wire.messages import Flags, Hello, Home, Info, Message, State

OTHER_PHYSICS = {
    "cart_mass": 0.8,
    "pole_mass": 0.15,
    "pole_com": 0.2,
    "pole_inertia": 2e-3,
    "track_half_length": 0.3,
    "cart_viscous": 1.0,
    "cart_coulomb_left": 0.8,
    "cart_coulomb_right": 0.8,
    "cart_stiction_ratio": 1.8,
    "pole_viscous": 1e-3,
    "pole_coulomb": 1e-3,
    "pole_drag": 1e-4,
    "force_curve": (0.0, 0.021, -0.99),
    "force_asymmetry": -0.03,
    "deadband_left": 90.0,
    "deadband_right": 90.0,
    "motor_time_constant": 0.02,
    "track_tilt": -0.002,
    "physics_step": 1e-3,
}
COARSE = {"physics_step": 1e-3}


class Driven:
    """An emulated cart driven in lockstep, without a wire."""

    def __init__(self, **settings: object) -> None:
        self.settings = truth(**COARSE | settings)
        self.rig = self.settings.hardware or nominal_hardware()
        self.encoders = self.rig.encoders
        self.cart = CartDevice(self.settings)
        self.flags = Flags(0)
        self.newest = 0  # tick of the newest STATE

    @property
    def x(self) -> float:
        return self.cart.physics.x

    @property
    def angle(self) -> float:
        return self.cart.physics.angle

    def tick(self) -> State:
        frame = decode_frame(self.cart.pass_period(self.cart.period_end_us)[-1][:-1])
        self.flags = Flags(frame.flags)
        assert isinstance(frame.message, State)
        self.newest = frame.message.tick
        return frame.message

    def ask(self, message: Message) -> State:
        self.cart.receive(encode_frame(answering(self.newest, message), 0)[:-1], self.cart.now_us)
        return self.tick()

    def info(self) -> Info:
        message = decode_frame(
            self.cart.receive(encode_frame(Hello(), 0)[:-1], self.cart.now_us)[0][:-1]
        ).message
        assert isinstance(message, Info)
        return message

    def limits(self) -> tuple[int, int]:
        """Soft and hard limit, counts from the middle, as INFO reports them."""
        return self.info().soft_limit_counts, self.info().hard_limit_counts

    def home(self) -> State:
        state = self.ask(Home())
        while self.flags & Flags.HOMING:
            state = self.ask(Hello())
        return state

    def tick_until(self, end_us: float) -> None:
        while self.cart.now_us < end_us:
            self.tick()

    def freeze(self, encoder: str, after_us: float = 0) -> None:
        """Let the count of an encoder stand still from a time on."""
        self.cart._settings = self.cart._settings.model_copy(update={"stuck_encoder": encoder})
        self.cart._stuck_us = self.cart.now_us + round(after_us)

    def measured(self, state: State) -> tuple[float, float]:
        return state.cart_counts * self.encoders.metres, state.pole_counts * self.encoders.radians


def homed(**settings: object) -> Driven:
    """Return a cart that has just homed: a copy, as the same settings are homed once."""
    original = homed_once(UnderTest.kind, tuple(settings.items()))
    old, twin = original.cart.firmware, None
    if isinstance(old, CFirmware):
        twin = original.cart._new_firmware()
        own_memory = twin._head.policy_memory
        ctypes.memmove(twin._memory, old._memory, len(old._memory))
        twin._head.policy_memory = own_memory
    driven = copy.deepcopy(original, {id(old): twin} if twin else {})
    driven.cart.firmware._delay_us = driven.cart._latency_us
    return driven


@functools.cache
def homed_once(kind: str, settings: tuple[tuple[str, object], ...]) -> Driven:
    """Return a cart of `settings` with the firmware `kind` that has just homed."""
    driven = Driven(**dict(settings))
    assert driven.home().fault == 0
    return driven


def check_homed(driven: Driven, state: State) -> None:
    """Check that the zeros are right within two counts and that cart and pole rest in place."""
    assert driven.flags == Flags.HOMED | driven.rig.switches * Flags.LEFT_SWITCH
    assert state.fault == 0
    x, angle = driven.measured(state)
    assert x == pytest.approx(driven.x, abs=2 * driven.encoders.metres)
    assert abs(driven.x) < 2e-3
    true = math.remainder(driven.angle, 2 * math.pi)
    offset = driven.settings.angle_offset
    assert math.remainder(angle - true - offset, 2 * math.pi) == pytest.approx(
        0, abs=2 * driven.encoders.radians
    )
    assert angle == pytest.approx(math.pi, abs=0.05)  # regardless of earlier turns
