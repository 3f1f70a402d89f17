"""Faults on purpose: restarts, frozen encoders, lost zeros. Pulled cables: test_process.py."""

import itertools
import math
import random
from collections.abc import Callable

import pytest

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from driven_cart import COARSE, Driven, check_homed, homed
from firmwares import one_firmware, truth

from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.emulator.firmware import BANNER
from cartpole_rl.wire.frames import decode_frame
from cartpole_rl.wire.messages import ClearFault, Fault, Flags, Hello, Home, SetMotor, Start, State

pytestmark = pytest.mark.usefixtures("each_firmware")


def test_a_reset_while_driving_stops_the_motor_and_loses_the_zeros():
    driven = homed()
    driven.ask(Start())
    driven.cart._reset_us = reset_us = driven.cart.now_us + 300_000
    while driven.cart.now_us < reset_us:
        assert driven.ask(SetMotor(150)).motor_applied == 150
    frames = driven.cart.pass_period(driven.cart.period_end_us)
    assert frames[0] == BANNER
    booted = decode_frame(frames[1][:-1])
    assert booted.message.tick == 1
    assert (booted.message.motor_applied, booted.message.fault, booted.sequence) == (0, 0, 0)
    assert Flags(booted.flags) == Flags(0)
    assert abs(booted.message.cart_counts) < 2000  # counted from where the cart was at the reset
    driven.ask(SetMotor(150))
    assert driven.tick().motor_applied == 0
    driven.cart.physics.place(0.0, math.pi)
    check_homed(driven, driven.home())


def test_every_boot_anywhere_is_homed():
    places = []
    for seed in range(4):
        driven = Driven(boot="anywhere", seed=seed)
        places.append((driven.x, driven.angle))
        check_homed(driven, driven.home())
    assert max(abs(x) for x, _ in places) > 0.15
    assert max(abs(math.remainder(angle - math.pi, 2 * math.pi)) for _, angle in places) > 1.0


def open_wire(driven: Driven, encoder: str) -> None:
    """Let the count of an encoder only change to and fro by one from now on."""
    which, disc_counts = ("cart", "pole").index(encoder), driven.cart._disc_counts
    first = disc_counts()[which]

    def counts() -> tuple[int, int]:
        now = [*disc_counts()]
        now[which] = first + (now[which] - first) // 2 % 2
        return now[0], now[1]

    driven.cart._disc_counts = counts


FAILURES = pytest.mark.parametrize("fail", [Driven.freeze, open_wire], ids=["frozen", "open wire"])


def frozen(
    encoder: str, motors: list[int], fail: Callable[[Driven, str], None] = Driven.freeze
) -> tuple[State, float]:
    """Return the STATE with a fault and the seconds of driving since an encoder froze after homing."""
    driven = homed()
    fail(driven, encoder)
    frozen_us = driven.cart.now_us
    driven.ask(Start())
    for motor in itertools.islice(itertools.cycle(motors), 100):
        state = driven.ask(SetMotor(motor))
        if state.fault:
            break
    return state, (driven.cart.now_us - frozen_us) / 1e6


@FAILURES
@pytest.mark.parametrize(("encoder", "fault"), [("cart", Fault.CART_ENCODER), ("pole", Fault.POLE_ENCODER)])
def test_a_frozen_encoder_is_detected_after_a_push_each_way(encoder, fault, fail):
    state, seconds = frozen(encoder, [200] * 10 + [-200] * 10, fail)
    assert state.fault == fault
    assert seconds < 0.6


@FAILURES
def test_a_frozen_cart_count_is_detected_after_20_mm_of_a_hard_push(fail):
    state, seconds = frozen("cart", [200], fail)
    assert state.fault == Fault.CART_ENCODER
    assert seconds < 0.2


class Slipping(CartDevice):
    """A pole encoder that stands still while its plug is loose, and then counts on: its zero is lost."""

    def __init__(self, **settings: object) -> None:
        self.lost, self.frozen = 0, None
        super().__init__(truth(**COARSE | settings))

    def _disc_counts(self) -> tuple[int, int]:
        cart, pole = super()._disc_counts()
        if self.frozen is not None:
            self.lost = pole - self.frozen
        return cart, pole - self.lost


def test_homing_after_a_lost_zero_neither_pumps_the_pole_nor_strikes_the_stops():
    driven = Driven()
    driven.cart = cart = Slipping()
    driven.home()
    cart.physics.place_pole(0.02)
    state = driven.ask(Start())
    cart.frozen = cart._disc_counts()[1]
    while not state.fault:
        for motor in (*[250] * 8, *[-250] * 8):
            state = driven.ask(SetMotor(motor))
    assert state.fault == Fault.POLE_ENCODER
    for _ in range(15):
        driven.tick()
    cart.frozen = None
    for _ in range(235):
        driven.tick()
    assert abs(math.remainder(cart.lost * 2 * math.pi / 4096, 2 * math.pi)) > 1.5
    driven.ask(ClearFault())
    driven.ask(Home())
    fastest = 0.0
    while driven.flags & Flags.HOMING:
        state = driven.ask(Hello())
        fastest = max(fastest, abs(cart.physics.x_dot))
    assert (state.fault, driven.flags) == (0, Flags.HOMED)
    assert fastest < 0.4


@pytest.mark.parametrize(
    ("dies", "pushed", "fastest"),  # s after HOME, s, m/s: on the way to the left, the right, the middle
    [(3.0, 1.0, 0.95), (9.0, 0.05, 0.3), (12.5, 0.05, 0.3)],
)
def test_a_cart_encoder_that_dies_in_homing_ends_it(dies, pushed, fastest):
    driven = Driven(stuck_encoder="cart", stuck_at=dies)
    driven.cart.physics.place(0.05, math.pi)
    state = driven.ask(Home())
    while driven.flags & Flags.HOMING:
        state = driven.ask(Hello())
    assert state.fault == Fault.HOMING
    assert driven.cart.now_us < 1e6 * (dies + pushed)
    assert abs(driven.cart.physics.x_dot) < fastest


@pytest.mark.parametrize(("held", "pushed"), [(12.5, 0.6), (14.5, 1.5)])
def test_a_cart_that_is_held_in_homing_ends_it(held, pushed):
    driven = Driven()
    driven.cart.physics.place(0.05, math.pi)
    state, place = driven.ask(Home()), driven.x
    while driven.flags & Flags.HOMING:
        if driven.cart.now_us > 1e6 * held:
            driven.cart.physics.place(place, driven.angle)
        place = driven.x
        state = driven.ask(Hello())
    assert state.fault == Fault.HOMING
    assert driven.cart.now_us < 1e6 * (held + pushed)


@FAILURES
@pytest.mark.parametrize(("encoder", "fault"), [("cart", Fault.HOMING), ("pole", Fault.POLE_ENCODER)])
def test_homing_fails_with_a_frozen_encoder(encoder, fault, fail):
    driven = Driven()
    fail(driven, encoder)
    assert driven.home().fault == fault
    assert driven.flags == Flags.FAULTED


@pytest.mark.parametrize(
    ("pole", "angle"),
    [({}, math.pi - 1.5), ({"pole_mass": 0.233, "pole_com": 0.328, "pole_inertia": 8e-3}, math.pi - 0.3)],
    ids=["medium", "large"],
)
def test_homing_does_not_go_on_pumping_the_swing_with_a_reversed_pole_encoder(pole, angle):
    driven, touched = Driven(**pole), []
    driven.cart.physics.place(0.05, angle)
    driven.cart.physics.on_contact = touched.append
    disc_counts = driven.cart._disc_counts
    driven.cart._disc_counts = lambda: (disc_counts()[0], -disc_counts()[1])
    assert driven.home().fault == Fault.HOMING
    driven.tick_until(driven.cart.now_us + 2e6)
    assert max(touched) < 0.15
    assert driven.cart.now_us < 35e6


@one_firmware
@pytest.mark.parametrize(
    "settings", [{}, {"pole_mass": 0.233, "pole_com": 0.328, "pole_inertia": 8e-3}, {"start": "upright"}]
)
def test_random_driving_through_swing_ups_raises_no_false_alarm(settings):
    """Drive 1500 periods with random values and durations; put the cart back after it reaches an end."""
    dice, driven = random.Random(5), homed(**settings)
    driven.ask(Start())
    lasts, fastest, faults = 0, 0.0, set()
    for _ in range(1500):
        if lasts == 0:
            lasts, motor = (
                dice.randint(1, 25),
                dice.choice([dice.randint(-255, 255), 200, -200, 255, -255, 0]),
            )
        lasts -= 1
        if abs(driven.x) > 0.2 and motor * driven.x > 0:
            motor = -motor
        state = driven.ask(SetMotor(motor))
        fastest = max(fastest, abs(driven.cart.physics.angle_dot))
        if state.fault:
            faults.add(Fault(state.fault))
            driven.cart.physics.place(0.0, driven.angle)
            driven.ask(ClearFault())
            driven.ask(Start())
    assert faults <= {Fault.HARD_LIMIT}
    assert fastest > 8.0  # rad/s: the pole went far up
