"""An emulated cart without a process or a wire, and a changed value of each of its physical settings."""

import math

import pytest
from firmwares import answering, truth

from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.wire import Flags, Hello, Home, Info, Message, State, decode_frame, encode_frame

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
        self.encoders = (self.settings.hardware or nominal_hardware()).encoders
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

    def measured(self, state: State) -> tuple[float, float]:
        return state.cart_counts * self.encoders.metres, state.pole_counts * self.encoders.radians


def check_homed(driven: Driven, state: State) -> None:
    """Check that the zeros are right within two counts and that cart and pole rest in place."""
    assert driven.flags == Flags.HOMED
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
