"""Firmware and physics together, without a process: homing, encoders, the hand, effects of settings."""

import math

import pytest

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from driven_cart import COARSE, OTHER_PHYSICS, Driven, check_homed, homed
from firmwares import one_firmware, truth

from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.rig.hardware import nominal_encoders
from cartpole_rl.wire.frames import encode_frame
from cartpole_rl.wire.messages import Fault, Flags, Hello, Home, SetMotor, SetPeriod, Start, Stop

pytestmark = pytest.mark.usefixtures("each_firmware")

METRES, RADIANS = nominal_encoders().metres, nominal_encoders().radians
NOMINAL_LIMITS = (16704, 17539)  # counts, as docs/protocol.md has them


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"angle_offset": -0.02, "track_tilt": -0.004},
        {"cart_coulomb_left": 0.9, "cart_coulomb_right": 0.8, "cart_viscous": 3.0, "latency": 0.02},
        {"cart_coulomb_left": 0.1, "cart_coulomb_right": 0.1, "motor_time_constant": 0.02},
        {"pole_mass": 0.23, "pole_com": 0.3302, "pole_inertia": 7.884e-3},
    ],
)
def test_homing_finds_the_zeros_of_any_healthy_cart(settings):
    driven = homed(**settings)
    check_homed(driven, driven.tick())
    assert driven.cart.now_us < 60e6


@pytest.mark.parametrize("turns", [-1, 2])
def test_homing_finds_the_zeros_again_after_the_pole_has_turned(turns):
    driven = homed()
    driven.cart.physics.place_pole(2 * math.pi * turns + 0.3)
    while driven.angle < 2 * math.pi * turns + 3:
        driven.tick()
    started = driven.cart.now_us
    check_homed(driven, driven.home())
    assert driven.cart.now_us - started < 60e6


@pytest.mark.parametrize("period_us", [5_000, 100_000])
def test_homing_works_at_the_shortest_and_the_longest_period(period_us):
    driven = Driven()
    driven.ask(SetPeriod(period_us))
    check_homed(driven, driven.home())


def test_homing_is_gentle():
    driven = Driven()
    driven.ask(Home())
    while driven.flags & Flags.HOMING:
        driven.tick()
        assert abs(math.remainder(driven.angle - math.pi, 2 * math.pi)) < 0.15


@pytest.mark.parametrize("half_length", [0.39, 0.425])
def test_a_track_of_the_wrong_length_is_a_fault(half_length):
    driven = Driven(track_half_length=half_length)
    assert driven.home().fault == Fault.HOMING
    assert driven.flags == Flags.FAULTED


def test_a_longer_track_is_searched_slowly_beyond_the_expected_stop():
    driven, touched = Driven(track_half_length=0.5), []
    driven.cart.physics.on_contact = touched.append
    assert driven.home().fault == Fault.HOMING
    assert len(touched) > 1  # the right stop, too
    assert max(touched) < 0.15


def test_the_limits_are_nominal_until_homing_has_found_the_stops():
    driven = Driven(track_half_length=0.4)
    assert driven.limits() == NOMINAL_LIMITS
    driven.ask(Home())
    while driven.flags & Flags.HOMING:
        assert driven.limits() == NOMINAL_LIMITS
        driven.tick()
    assert [limit * METRES for limit in driven.limits()] == pytest.approx(
        [0.4 - 0.027, 0.4 - 0.008], abs=1e-4
    )


def test_limits_and_zeros_last_until_another_homing_succeeds_or_the_cart_restarts():
    driven = homed(track_half_length=0.4)
    driven.freeze("cart", 4e6)
    driven.cart._reset_us = 100_000_000
    found, state = driven.limits(), driven.ask(Home())
    while driven.flags & Flags.HOMING:
        if driven.cart.now_us < driven.cart._stuck_us:
            assert driven.measured(state)[0] == pytest.approx(driven.x, abs=2 * METRES)
        assert driven.limits() == found
        state = driven.tick()
    assert state.fault == Fault.HOMING
    off = driven.measured(state)[1] - driven.angle - driven.settings.angle_offset
    assert math.remainder(off, 2 * math.pi) == pytest.approx(0, abs=2 * RADIANS)
    assert driven.limits() == found
    driven.tick_until(100e6 + 1)
    assert driven.limits() == NOMINAL_LIMITS


def test_neither_watchdog_nor_limits_hold_while_homing():
    """Without SET_MOTOR the cart moves beyond both limits of an earlier homing, to the stops."""
    driven = homed()
    soft, hard = driven.limits()
    farthest, outward, state = 0, 0, driven.ask(Home())
    while driven.flags & Flags.HOMING:
        assert not driven.flags & (Flags.SOFT_LIMIT | Flags.WATCHDOG)
        farthest = max(farthest, abs(state.cart_counts))
        outward += abs(state.cart_counts) > soft and state.motor_applied * state.cart_counts > 0
        state = driven.ask(Hello())
    assert state.fault == 0
    assert farthest > hard
    assert outward > 10


def test_counts_follow_the_true_state():
    driven = homed()
    driven.ask(Start())
    for tick in range(200):
        state = driven.ask(SetMotor(200 if tick // 10 % 2 else -200))
        x, angle = driven.measured(state)
        assert x == pytest.approx(driven.x, abs=2 * METRES)
        assert angle - driven.angle - driven.settings.angle_offset == pytest.approx(0, abs=2 * RADIANS)


def test_soft_limit_stops_a_slow_cart():
    driven = homed(cart_viscous=3.0)
    driven.ask(Start())
    limited = False
    for _ in range(600):
        state = driven.ask(SetMotor(90))
        limited |= bool(driven.flags & Flags.SOFT_LIMIT)
    assert limited
    assert state.fault == 0
    assert driven.info().soft_limit_counts <= state.cart_counts < driven.info().hard_limit_counts


def test_a_hand_holds_the_pole_up_until_the_cart_is_armed():
    driven = Driven(start="upright", angle_offset=0.0)
    driven.home()
    held = [driven.ask(Hello()) for _ in range(3)]
    assert len({state.pole_counts for state in held}) == 1
    assert abs(held[0].pole_counts * RADIANS) <= 0.03 + RADIANS
    driven.ask(Start())
    for _ in range(30):
        state = driven.ask(SetMotor(0))
    assert abs(state.pole_counts * RADIANS) > 0.1 or held[0].pole_counts == 0


def test_a_hand_takes_the_pole_again_at_another_angle_and_releases_it_for_homing():
    driven = Driven(start="upright")
    driven.home()
    first = driven.ask(Hello())
    driven.ask(Start())
    for _ in range(40):
        driven.ask(SetMotor(0))
    driven.ask(Stop())
    second = driven.ask(Hello())
    assert abs(math.remainder(second.pole_counts * RADIANS, 2 * math.pi)) <= 0.03 + 0.006
    assert second.pole_counts != first.pole_counts
    state = driven.home()
    assert state.fault == 0
    assert state.pole_counts == pytest.approx(2048 + 0.004 / RADIANS, abs=3)
    assert abs(driven.ask(Hello()).pole_counts * RADIANS) <= 0.03 + 0.006


def trace(**settings: object) -> bytes:
    """Return all bytes that a cart sends for one series of commands after boot; `homed` is set by hand."""
    cart = CartDevice(truth(**COARSE | settings))
    cart.firmware.homed = True
    sent = cart.receive(encode_frame(Start(), 0)[:-1], 0)
    motors = (85, -85, 80, -80, 0, 150, -150, 200, -255, 0, 255, 255, 255) * 2
    for number, motor in enumerate(motors):
        for tick in range(6 * number, 6 * number + 6):
            sent += cart.receive(encode_frame(SetMotor(motor, tick), 1)[:-1], cart.now_us)
            sent += cart.pass_period(cart.period_end_us)
    sent += cart.receive(encode_frame(Stop(), 2)[:-1], cart.now_us)
    for _ in range(20):
        sent += cart.pass_period(cart.period_end_us)
    return b"".join(sent)


OTHER = OTHER_PHYSICS | {
    "seed": 1,
    "pole_drag": 2e-4,
    "backdrivability": 0.5,
    "coasting": 0.5,
    "latency": 0.01,
    "latency_jitter": 0.003,
    "track_tilt": -0.004,
    "angle_offset": 0.0045,
    "reset_at": 1.0,
    "boot": "anywhere",
    "start": "upright",
    "physics_step": 5e-4,
}


@pytest.fixture(scope="module")
def base() -> bytes:
    return trace()


def test_the_same_settings_send_the_same_bytes(base):
    assert trace() == base


@one_firmware
@pytest.mark.parametrize("name", OTHER)
def test_another_value_sends_other_bytes(base, name):
    assert trace(**{name: OTHER[name]}) != base


def test_every_setting_is_tried_here_or_on_the_wire():
    elsewhere = {"clock", "frame_loss", "frame_corruption"}  # test_process.py
    elsewhere |= {"frame_duplication", "frame_reordering"}  # test_link.py
    elsewhere |= {"unplug_at", "stuck_encoder", "stuck_at"}  # test_faults.py
    elsewhere |= {"cogging", "cogging_pitch"}  # test_physics.py
    elsewhere |= {"firmware", "policy", "hardware", "given", "cart"}  # test_onboard_policy.py, test_rigs.py
    elsewhere |= {"journal", "port"}  # tests/plants/test_stops.py, tests/plants/serial/test_tcp.py
    elsewhere |= {"clock_rate", "knock"}  # below
    assert set(OTHER) | elsewhere == set(EmulatorSettings.model_fields)


def test_a_fast_clock_makes_short_periods():
    """A pole that falls from upright falls less far in the same number of periods."""

    def fallen(rate: float) -> float:
        cart = CartDevice(truth(clock_rate=rate))
        cart.physics.place_pole(0.1)
        for _ in range(20):
            cart.pass_period(cart.period_end_us)
        return cart.physics.angle

    assert fallen(1.3) == pytest.approx(0.1 + (fallen(1.0) - 0.1) / 1.3**2, rel=0.25)
    assert fallen(0.6) > fallen(1.0) > fallen(1.3) > 0.1


def test_a_standing_pole_is_knocked_once_after_each_start_to_either_side():
    cart = CartDevice(EmulatorSettings(knock=4.0))
    cart.firmware.homed = True

    def knocks() -> list[tuple[int, float]]:
        cart.receive(encode_frame(Start(), 0)[:-1], cart.now_us)
        found = []
        for period in range(1, 251):
            cart.physics.place_pole(0.0)
            cart.pass_period(cart.period_end_us)
            if abs(cart.physics.angle_dot) > 1:
                found.append((period, round(cart.physics.angle_dot, 1)))
        cart.receive(encode_frame(Stop(), 0)[:-1], cart.now_us)
        cart.pass_period(cart.period_end_us)
        return found

    assert knocks() == [(100, 4.0)]
    assert knocks() == [(100, -4.0)]


def test_latency_delays_the_force_by_its_value():
    def moved(latency: float) -> float:
        settings = truth(latency=latency, latency_jitter=0.0, motor_time_constant=0.0)
        cart = CartDevice(settings)
        cart.firmware.homed = True
        cart.receive(encode_frame(Start(), 0)[:-1], 0)
        start = cart.physics.x
        for tick in range(2):
            cart.receive(encode_frame(SetMotor(250, tick), 0)[:-1], cart.now_us)
            cart.pass_period(cart.period_end_us)
        return cart.physics.x - start

    assert moved(0.02) == pytest.approx(moved(0.0) / 4, rel=0.05)  # half the time: a quarter of the way
    assert moved(0.05) == pytest.approx(0.0, abs=1e-6)
