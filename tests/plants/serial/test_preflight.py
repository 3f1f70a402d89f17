"""The checks of a cart, on the emulated one: a good one, wires the wrong way round, and other faults."""

import json
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serial_peer import INFO, Between, CartPeer

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import FaultError
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.preflight import (
    Finding,
    Probe,
    cart_direction,
    deadband,
    latency,
    limits,
    pole_direction,
    preflight,
    soft_limit,
    swinging_on,
)
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.wire.messages import Flags, Home, SetMotor, State

TRUTH: dict[str, Any] = {
    "deadband_right": 100.0,
    "deadband_left": 0.0,
    "cart_coulomb_left": 0.5,  # the breakaway force, 0.6 N, is that of motor value 80
    "cart_coulomb_right": 0.5,
    "force_curve": (0.0, 0.02, -1.0),
    "latency": 0.012,
    "latency_jitter": 0.0,
    "motor_time_constant": 0.0,
    "track_tilt": 0.0,
}
fast = partial(EmulatorSettings, physics_step=1e-3)
good_limits = replace(INFO, soft_limit_counts=16704, hard_limit_counts=17539)


def patient(port: str) -> SerialSettings:
    return SerialSettings(port=port, timeout=5, nudge_after=2, answer_timeout=2, connect_timeout=10)


def findings(port: str, **changes: float) -> list[Finding]:
    """Return what the preflight of the cart on a port finds."""
    cart = SerialCart(patient(port).model_copy(update=changes))
    found = list(preflight(cart))
    cart.close()
    return found


@pytest.fixture(scope="module")
def emulated() -> Iterator[EmulatedCart]:
    """A cart that is homed."""
    with EmulatedCart(fast(**TRUTH)) as emulated:
        with SerialCart(patient(emulated.port)) as cart:
            cart.home()
        yield emulated


@pytest.fixture
def probe(emulated: EmulatedCart) -> Iterator[Probe]:
    with SerialCart(patient(emulated.port)) as cart:
        yield Probe(cart)
    settle(emulated)


def settle(emulated: EmulatedCart) -> None:
    """Bring the cart back to the middle, for the next test."""
    with SerialCart(patient(emulated.port)) as cart:
        probe = Probe(cart)
        probe.arm()
        probe.centre()


def test_what_is_measured_is_the_truth(probe: Probe) -> None:
    assert "motor value +10" in cart_direction(probe)
    assert "swings the hanging pole to the left" in pole_direction(probe)
    deadband(probe)
    assert 100 < probe.deadband[+1] < 106  # a ramp goes on by one a period until the motion is seen
    assert 80 < probe.deadband[-1] < 88
    words = latency(probe)
    assert 11 <= float(words.split(" ms")[0].split()[-1]) <= 15
    assert "confirms the value after 20 ms" in words
    assert "not reached" in soft_limit(probe)
    assert probe.farthest * 22749e-9 < 0.05


@pytest.mark.parametrize("period", [0.02, 0.1])
@pytest.mark.parametrize("seconds", [0.7, 0.95, 1.06, 1.3, 2.0])  # of a swing
def test_a_swing_goes_on_as_it_did(
    period: float, seconds: float, probe: Probe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Probe, "period", period)
    times, pushed = period * np.arange(round(7 / period)), round(0.3 / period)
    counts = np.rint(2048 + 40 * np.exp(-times / 20) * np.sin(2 * math.pi * times / seconds)).astype(int)
    expected, error = swinging_on(probe, counts[:-pushed].tolist(), swings=True)
    assert len(expected) == pushed
    assert np.abs(expected - counts[-pushed:]).max() <= error + 1 <= 6


def test_a_hand_is_no_swing(probe: Probe) -> None:
    """It moves the pole as if in two swings at once: where it will be is not known."""
    times = 0.02 * np.arange(350)
    counts = np.rint(2048 + 60 * np.sin(2.1 * times) + 30 * np.sin(4.0 * times)).astype(int)
    expected, error = swinging_on(probe, counts[:300].tolist(), swings=True)
    assert np.abs(expected - counts[300:315]).max() <= 2 * error


def test_a_pole_that_hangs_still_goes_on_hanging(probe: Probe) -> None:
    assert swinging_on(probe, [2048, 2049, 2047, 2048], swings=False) == ([2048] * 15, 0)


def test_a_swing_goes_on_while_this_computer_is_late(probe: Probe, monkeypatch: pytest.MonkeyPatch) -> None:
    def pushed(periods: int) -> State:
        swing = -100 * math.sin(2 * math.pi * periods / 50)
        return State(1000 + periods, 0, 0, 2048 + round(swing) + 4 * max(0, periods), 0, 0, 0, 0)

    states = map(pushed, count(6))
    probe.deadband[+1] = 80
    monkeypatch.setattr(
        probe, "calm", lambda *given: ([pushed(-before) for before in range(750, -1, -1)], 200)
    )
    monkeypatch.setattr(probe, "drive", lambda motor: next(states))
    monkeypatch.setattr(probe, "centre", lambda: None)
    assert "to the left, +2" in pole_direction(probe)  # 24, within the error of the sine


class Recording(Probe):
    """A probe that notes its motor values."""

    def __init__(self, cart: SerialCart) -> None:
        super().__init__(cart)
        self.motors: list[int] = []

    def drive(self, motor: int) -> State:
        self.motors.append(motor)
        return super().drive(motor)


def test_a_small_dead_band_does_not_make_the_way_back_rattle() -> None:
    small, breakaway = 16, 0.32  # motor value, N
    easy = {
        "deadband_right": 0.0,
        "cart_coulomb_left": breakaway / 1.2,
        "cart_coulomb_right": breakaway / 1.2,
    }
    with (
        EmulatedCart(fast(**TRUTH | easy | {"force_curve": (0.0, 0.02, 0.0)})) as emulated,
        SerialCart(patient(emulated.port)) as cart,
    ):
        cart.home()
        probe = Recording(cart)
        probe.arm()
        deadband(probe)
        assert max(probe.deadband.values()) == pytest.approx(small, abs=8)
        for side in (+1, -1):
            before = state = probe.settle()
            while abs(state.cart_counts - before.cart_counts) < 440:  # 10 mm; it rolls on
                state = probe.drive(side * (probe.deadband[side] + 60))
            probe.motors = []
            probe.centre()
            driven = [motor for motor in probe.motors if motor]
            assert len(driven) > 5
            assert sum(one * other < 0 for one, other in pairwise(driven)) <= 2
            assert len(probe.motors) < 150
        assert probe.farthest * 22749e-9 < 0.07


@pytest.mark.parametrize("signs", [{"motor": -1}, {"cart": -1}])
def test_a_motor_or_a_cart_encoder_the_wrong_way_round(emulated: EmulatedCart, signs: dict[str, int]) -> None:
    with Between(emulated.port, **signs) as cable, SerialCart(patient(cable.port)) as cart:
        with pytest.raises(
            NotReadyError, match=r"moves the cart's count down, .*swap its encoder's wires A and B"
        ):
            cart_direction(Probe(cart))
        assert abs(cart.poll_state().cart_counts) < 2000
    settle(emulated)


@pytest.mark.parametrize("signs", [{"pole": -1}, {"motor": -1, "cart": -1}])
def test_a_pole_encoder_the_wrong_way_round(emulated: EmulatedCart, signs: dict[str, int]) -> None:
    with Between(emulated.port, **signs) as cable, SerialCart(patient(cable.port)) as cart:
        probe = Probe(cart)
        cart_direction(probe)
        with pytest.raises(
            NotReadyError, match=r"pole's count down, by \d+: swap the wires A and B of the pole"
        ):
            pole_direction(probe)


def test_a_motor_without_power(probe: Probe, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = probe.cart.set_motor
    monkeypatch.setattr(probe.cart, "set_motor", lambda value: asked(0))
    with pytest.raises(
        NotReadyError, match=r"the motor pushes, but .* does not change: switch the motor's supply on"
    ):
        cart_direction(probe)


def test_a_cart_that_hardly_moves() -> None:
    rough = nominal_hardware().model_copy(update={"moving_friction": 1.5})  # as its file says
    truth = {**TRUTH, "deadband_left": 170.0, "hardware": rough.model_dump()}
    with EmulatedCart(fast(**truth)) as stiff, SerialCart(patient(stiff.port), rough) as cart:
        cart.home()
        probe = Probe(cart)
        cart_direction(probe)
        with pytest.raises(NotReadyError, match=r"-17\d left: clean the track"):
            deadband(probe)


@pytest.mark.parametrize("moment", [28.6, 39.5])  # s: before the first ramp, and between two
def test_a_count_that_froze_does_not_let_a_ramp_reach_the_stops(moment: float, tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    with EmulatedCart(fast(stuck_encoder="cart", stuck_at=moment, journal=journal)) as emulated:
        *_, last = findings(emulated.port)
    assert re.match(
        r"at a motor value of [+-]1\d\d, the motor pushes, but the cart's count does not", last.words
    )
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    started = next(line["us"] for line in lines if line.get("took") == "START")
    assert not [line for line in lines if "touched" in line and line["us"] > started]


def test_a_slow_motor(probe: Probe) -> None:
    cart_direction(probe)
    deadband(probe)
    probe.cart.__class__ = Sluggish
    with pytest.raises(NotReadyError, match=r"begins to move \d+ ms after .*look for a ramp"):
        latency(probe)


class Sluggish(SerialCart):
    """Hands each motor value on three periods late."""

    def set_motor(self, value: int) -> int:
        waiting = self.__dict__.setdefault("waiting", [0, 0, 0])
        waiting.append(value)
        return super().set_motor(waiting.pop(0))


def test_a_restart_is_a_finding_whatever_the_check_made_of_it() -> None:
    """The counts begin anew, which looks like wires the wrong way round."""
    with EmulatedCart(fast(reset_at=28)) as emulated:
        *_, last = findings(emulated.port)
    assert not last.ready
    assert last.words == "the cart has restarted; check its power"


def test_a_cart_that_does_not_move_is_a_finding_with_its_remedy() -> None:
    with EmulatedCart(fast(stuck_encoder="cart", stuck_at=0.0)) as emulated:
        *before, last = findings(emulated.port)
    assert [finding.check for finding in before] == ["link", "limits"]
    assert (last.check, last.ready) == ("homing", False)
    assert last.words == (
        "homing failed: the cart's count does not change: switch the motor's supply on, check the cables of "
        "the motor and of the cart's encoder, free the cart"
    )


def test_the_motor_is_stopped_before_a_check_that_failed_is_shown(peer: CartPeer) -> None:
    """Whoever shows it may block: a terminal that was stopped, a full pipe."""
    with SerialCart(SerialSettings(port=peer.port)) as cart:
        for finding in preflight(cart):
            assert finding.ready or not peer.flags & Flags.ARMED
        assert (finding.check, finding.ready) == ("cart encoder", False)
        assert any(message.motor for message in peer.messages(SetMotor))


def test_a_bad_cable_is_told_before_anything_moves() -> None:
    with EmulatedCart(fast(frame_corruption=0.2)) as emulated:
        (finding,) = findings(emulated.port, answer_timeout=0.05, nudge_after=0.05, retries=30)
    assert not finding.ready
    assert "use a short shielded cable" in finding.words
    assert "set BAUD in the board's file, flash again, and give plant.baud=115200" in finding.words


def test_the_lines_of_another_carts_file_are_told() -> None:
    assert "soft 380 mm" in limits(good_limits, Flags.HOMED, nominal_hardware())
    other = replace(good_limits, cart_nanometres_per_count=84980, pole_counts_per_turn=4271)
    with pytest.raises(NotReadyError) as refused:
        limits(other, Flags.RIGHT_SWITCH, nominal_hardware())
    assert "`pole_counts_per_turn: 4271`, `right_switch: 1` into a file" in refused.value.remedy


@pytest.mark.parametrize("period_us", [0, 100_001])
def test_a_period_that_the_protocol_does_not_allow(peer: CartPeer, period_us: int) -> None:
    peer.info = replace(good_limits, period_us=period_us)
    (finding,) = findings(peer.port)
    assert (finding.check, finding.ready) == ("link", False)
    assert finding.words.startswith(f"INFO says period {period_us} us, not 5000 to 100000: correct the firm")


def test_a_cart_that_falls_silent_is_a_finding(peer: CartPeer) -> None:
    talk, peer.info = peer.answer, good_limits
    peer.answer = lambda frame: () if peer.messages(Home) else talk(frame)
    *before, last = findings(peer.port, answer_timeout=0.05, retries=1)
    assert [finding.check for finding in before] == ["link", "limits"]
    assert (last.check, last.ready) == ("homing", False)
    assert "did not answer HOME, asked 2 times: check its cable and power" in last.words


def test_a_cart_too_far_out_is_stopped_and_a_fault_ends_a_move(peer: CartPeer) -> None:
    with SerialCart(patient(peer.port)) as cart:
        peer.state = replace(peer.state, cart_counts=4000)
        with pytest.raises(NotReadyError, match=r"went \+91 mm, further than any requested move"):
            Probe(cart).arm()
        assert not peer.flags & Flags.ARMED
        peer.state = replace(peer.state, cart_counts=0, fault=2)
        with pytest.raises(FaultError, match="did not move"):
            Probe(cart).arm()
