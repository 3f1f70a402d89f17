"""The limits of the track: whatever a host sends, an armed cart touches no end stop faster than 0.1 m/s."""

import itertools
import math
import random
from collections.abc import Iterator

import pytest

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from driven_cart import Driven, homed

from cartpole_rl.wire.frames import decode_frame, encode_frame
from cartpole_rl.wire.messages import (
    ClearFault,
    Fault,
    Flags,
    Hello,
    Home,
    Nack,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    Stop,
)

pytestmark = pytest.mark.usefixtures("each_firmware")

SECONDS = 8.0
LARGE = {"pole_mass": 0.230, "pole_com": 0.3302, "pole_inertia": 7.884e-3}
HEAVY = {"cart_mass": 1.1}
SLIPPERY = {"cart_viscous": 0.1, "cart_coulomb_left": 0.25, "cart_coulomb_right": 0.25}
Host = Iterator[int | None]  # the motor values that it sends, None where it sends nothing


def outward(driven: Driven) -> Host:
    """Full motor to the right, for ever."""
    return itertools.repeat(255)


def to_and_fro(driven: Driven) -> Host:
    """Full motor for half a second to each side."""
    while True:
        yield 255 if driven.cart.now_us % 1_000_000 < 500_000 else -255


def pumping(driven: Driven) -> Host:
    """Whirl the pole as fast as the motor can, then run to one end and to the other."""
    physics = driven.cart.physics
    while True:
        if abs(physics.angle_dot) > 12:
            yield 255 if driven.cart.now_us % 2_400_000 < 1_200_000 else -255
        else:
            yield 255 if physics.angle_dot * math.cos(physics.angle) < 0 else -255


def dying(driven: Driven) -> Host:
    """Full motor to one side, then nothing: a host that dies again and again."""
    dice = random.Random(3)
    while True:
        motor, lasts_us = dice.choice([255, -255]), dice.randint(100_000, 900_000)
        began_us = driven.cart.now_us
        while driven.cart.now_us < began_us + 1_300_000:
            yield motor if driven.cart.now_us < began_us + lasts_us else None


@pytest.mark.parametrize(
    ("cart", "period_us"),
    [(LARGE, 20_000), (HEAVY, 100_000), (SLIPPERY, 5_000), (SLIPPERY, 100_000)],
    ids=["large", "heavy slow", "slippery fast", "slippery slow"],
)
@pytest.mark.parametrize("host", [outward, to_and_fro, pumping, dying])
def test_no_host_drives_the_cart_against_a_stop(host, cart, period_us):
    driven, touched = ready(**cart, period_us=period_us)
    motors, fastest = host(driven), 0.0
    ends_us = driven.cart.now_us + SECONDS * 1e6
    while driven.cart.now_us < ends_us:
        if not driven.cart.firmware.armed:  # it crept into the hard limit
            driven.ask(ClearFault())
            driven.ask(Start())
        motor = next(motors)
        driven.tick() if motor is None else driven.ask(SetMotor(motor))
        fastest = max(fastest, abs(driven.cart.physics.x_dot))
    assert max(touched, default=0.0) <= 0.1
    assert fastest > 0.5  # the limits leave it room to drive


def test_a_cart_that_is_left_under_a_swinging_pole_is_braked_until_it_rests():
    """The pole turns it round several times: a cart that stands for a moment does not rest."""
    driven, touched = ready(**LARGE)
    motors = to_and_fro(driven)
    for stop in range(6):
        driven.cart.physics.place_pole(driven.angle, 9.0)
        for _ in range(20 + 10 * stop):
            driven.ask(SetMotor(next(motors)))
        driven.ask(Stop())
        driven.tick_until(driven.cart.now_us + 4e6)
        driven.ask(Start())
    assert max(touched, default=0.0) <= 0.1


@pytest.mark.parametrize("after", [0.1, 0.4])
@pytest.mark.parametrize("cart", [LARGE, SLIPPERY], ids=["large", "slippery"])
@pytest.mark.parametrize("host", [outward, to_and_fro])
def test_a_cart_whose_encoder_freezes_is_stopped_before_it_touches_a_stop(host, cart, after):
    driven, touched = ready(**cart)
    driven.freeze("cart", 1e6 * after)
    motors, end_us = host(driven), driven.cart.now_us + 4e6
    while driven.cart.now_us < end_us:
        state = driven.ask(SetMotor(next(motors))) if driven.cart.firmware.armed else driven.tick()
    assert state.fault & Fault.CART_ENCODER
    assert max(touched, default=0.0) <= 0.1


def ready(period_us: int = 20_000, **cart: float) -> tuple[Driven, list[float]]:
    """Return a homed and armed cart, and the list of the speeds at which it touches a stop from then on."""
    driven, touched = homed(**cart), []
    driven.cart.physics.on_contact = touched.append
    driven.ask(SetPeriod(period_us))
    driven.tick_until(driven.cart.now_us + 1e6)
    driven.ask(Start())
    return driven, touched


@pytest.mark.parametrize("leave", [Stop(), None], ids=["stop", "silence"])
def test_a_cart_that_is_left_at_speed_is_braked_and_then_left_alone(leave):
    driven, touched = ready()
    while driven.x < 0.1:
        driven.ask(SetMotor(255))
    assert driven.cart.physics.x_dot > 0.6
    if leave is not None:
        driven.ask(leave)
    motors = []
    while -255 not in motors:  # the brake
        motors.append(driven.tick().motor_applied)
    answer = driven.cart.receive(encode_frame(Home(), 9)[:-1], driven.cart.now_us)[0][:-1]
    assert decode_frame(answer).message == Nack(9, Home.TYPE, Reason.BUSY)
    motors += [driven.tick().motor_applied for _ in range(200)]
    assert max(motors[5:]) == 0
    assert motors[-100:] == [0] * 100
    assert max(touched, default=0.0) <= 0.1


def test_a_hand_that_moves_an_idle_cart_is_not_fought():
    driven, _ = ready()
    driven.ask(Stop())
    for _ in range(200):
        driven.tick()
    driven.cart.physics._data.qvel[0] = 1.2
    assert {driven.tick().motor_applied for _ in range(20)} == {0}


def test_a_limit_that_acts_is_reported():
    driven, _ = ready()
    flags = Flags(0)
    while not flags & Flags.SOFT_LIMIT:
        state = driven.ask(SetMotor(255))
        flags = driven.flags
    assert state.motor_applied in (0, -255)
    assert driven.measured(state)[0] < 0.375  # before the soft limit


@pytest.mark.parametrize("frames", [0, 4])
def test_homing_ends_half_a_second_after_its_host_died(frames):
    driven = Driven()
    driven.ask(Home())
    for _ in range(frames):
        driven.ask(Hello())
    heard_us = driven.cart.now_us - 20_000
    motors = []
    while driven.flags & Flags.HOMING:
        motors.append(driven.tick().motor_applied)
    assert 500_000 < driven.cart.now_us - heard_us <= 520_000
    assert any(motors)
    assert motors[-1] == 0
    assert not driven.flags & (Flags.HOMED | Flags.FAULTED)


@pytest.mark.parametrize(
    ("age", "motor", "stale"), [(0, 9, 0), (2, 9, 0), (3, 9, 1), (-1, 9, 1), (300, 0, 0)]
)
def test_a_motor_value_that_answers_an_old_or_unknown_state_is_refused(age, motor, stale):
    driven, _ = ready()
    frame = encode_frame(SetMotor(motor, driven.newest - age), 7)[:-1]
    answers = [decode_frame(one[:-1]).message for one in driven.cart.receive(frame, driven.cart.now_us)]
    assert answers == ([Nack(7, SetMotor.TYPE, Reason.STALE)] if stale else [])


@pytest.mark.parametrize("age", [0, 1, 2])
def test_no_motor_value_is_in_force_three_periods_after_the_state_that_it_answers(age):
    """It arrives late, the last one before the host falls silent."""
    driven, _ = ready()
    answered = driven.newest
    for _ in range(age):
        driven.tick()
    in_force = {driven.newest: 0, **dict(applied(driven, SetMotor(100, answered), periods=5))}
    assert [tick - answered for tick, motor in in_force.items() if motor] == list(range(age + 1, 3))


def applied(driven: Driven, message: SetMotor, periods: int) -> Iterator[tuple[int, int]]:
    """Send a message; yield (tick, motor value in force) of the next states."""
    state = driven.ask(message)
    for _ in range(periods):
        yield state.tick, state.motor_applied
        state = driven.tick()
