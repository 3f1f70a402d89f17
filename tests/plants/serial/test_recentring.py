"""Episodes on emulated carts, in lockstep over a pseudo-terminal.

Between episodes the cart is brought back to the middle, and homed where that will not do.
"""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from serial_peer import HANGING, CartPeer

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError, RefusedError
from cartpole_rl.plants.serial.moves import recentre
from cartpole_rl.plants.serial.plant import SerialPlant, emulated_plant
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Fault, Flags, Home, Nack, Reason, SetMotor

TURN = 4096
MIDDLE = 100  # counts, 2.3 mm
HOMING = 20.0  # s; no homing is done sooner, no re-centring of the default cart takes so long
fast = partial(EmulatorSettings, physics_step=1e-3)


def swing_up(plant: SerialPlant, steps: int = 90, half_swing: int = 12) -> None:
    """Wild but within the track: the pole is left turning or swinging far, the cart off the middle."""
    motor = 200
    for step in range(steps):
        counts = plant.step_one(motor).counts[0]
        if step % half_swing == 0:
            motor = -motor
        if abs(counts) > 5000:
            motor = -200 if counts > 0 else 200
    assert plant.ended_by == ""


def reset(plant: SerialPlant, most: int = 16) -> float:
    """Begin an episode; return the seconds that it took by the cart's clock.

    It begins in the middle; the pole hangs, within `most` counts.
    """
    before = plant.cart.poll_state().time_us
    plant.cart.statistics.latency.clear()
    frame = plant.reset_one()
    cart, pole = frame.counts
    assert abs(cart) < MIDDLE
    assert abs(pole - TURN // 2) < most
    assert not frame.ends
    return (plant.cart.poll_state().time_us - before) * 1e-6


@pytest.fixture(scope="module")
def plant() -> Iterator[SerialPlant]:
    with contextlib.closing(emulated_plant(fast())) as plant:
        yield plant


@pytest.mark.parametrize(
    "truth",
    [
        {"cart_coulomb_left": 0.8, "cart_coulomb_right": 0.6, "latency": 0.023},
        pytest.param(
            {"pole_mass": 0.23, "pole_com": 0.3302, "pole_inertia": 0.0079, "track_tilt": 0.0087},
            marks=pytest.mark.nightly,
        ),
        pytest.param(
            {"pole_viscous": 1e-5, "pole_coulomb": 0.0, "pole_drag": 0.0}, marks=pytest.mark.nightly
        ),
    ],
    ids=["friction and latency", "large on a tilt", "no pole friction"],
)
def test_many_carts_come_back_to_the_middle_sooner_than_homing(truth: dict[str, Any]) -> None:
    with contextlib.closing(emulated_plant(fast(**truth))) as plant:
        homing = reset(plant)
        swing_up(plant)
        plant.halt()
        assert reset(plant) < 0.6 * homing


@pytest.mark.parametrize("period", [0.01, 0.1])
def test_other_control_periods(period: float) -> None:
    with contextlib.closing(emulated_plant(fast(), period)) as plant:
        plant.reset()
        swing_up(plant, round(1.8 / period), max(1, round(0.24 / period)))
        plant.halt()
        assert reset(plant) < HOMING


def test_moves_of_the_host_are_no_latencies_of_the_policy(plant: SerialPlant) -> None:
    """Nor do whole turns of the pole add up."""
    plant.reset_one()
    for _ in range(2):
        swing_up(plant, 150)
        assert reset(plant) < HOMING
        assert plant.cart.statistics.summary()["latency_samples"] == 0
    plant.step_one(0)
    assert plant.cart.statistics.summary()["latency_samples"] == 1


def test_rehome_always_homes_each_time() -> None:
    with contextlib.closing(emulated_plant(fast(), rehome="always")) as plant:
        for _ in range(2):
            assert reset(plant, most=10) > HOMING
            plant.step_one(100)


def test_a_cart_that_has_restarted_is_homed() -> None:
    with contextlib.closing(emulated_plant(fast(reset_at=26.0))) as plant:
        plant.reset()
        for _ in range(150):
            if plant.step_one(0).ends:
                break
        assert plant.ended_by == "link"
        plant.reset()
        assert plant.cart.poll_state().time_us > HOMING * 1e6
        assert plant.cart.flags & Flags.HOMED


def test_disturbed_frames_do_not_hinder_it() -> None:
    disturbed = fast(frame_loss=0.03, frame_corruption=0.03, frame_reordering=0.03, frame_duplication=0.03)
    with contextlib.closing(emulated_plant(disturbed)) as plant:
        plant.reset()
        swing_up(plant)
        reset(plant)
        seen = plant.cart.statistics.summary()
        assert min(seen[f"{name}_frames"] for name in ("overtaken", "repeated", "lost")) > 5


@pytest.mark.parametrize("side", [1, -1])
def test_the_end_of_the_track_ends_the_episode_and_the_next_one_begins(plant: SerialPlant, side: int) -> None:
    reset(plant)
    for _ in range(200):
        frame = plant.step_one(side * 250)
        if frame.ends:
            break
    assert (frame.terminated, frame.truncated, plant.ended_by) == ((True,), (False,), "track")
    assert side * frame.counts[0] >= plant.cart.information.soft_limit_counts
    assert side * plant.cart.poll_state().motor_applied <= 0  # the firmware brakes
    assert reset(plant) < HOMING  # its brake lost no counts: it need not home


def test_an_upright_start() -> None:
    said: list[str] = []
    with contextlib.closing(emulated_plant(fast(start="upright"), prompt=said.append)) as plant:
        for episode in (1, 2):
            pole = plant.reset_one().counts[1]
            assert abs((pole + TURN // 2) % TURN - TURN // 2) < 60
            assert len(said) == episode
            falling = [plant.step_one(0).counts[1] for _ in range(60)]
            assert abs(falling[-1] - pole) > 300


def test_pole_length_is_that_of_the_emulated_pole(plant: SerialPlant) -> None:
    assert plant.pole_length.tolist() == pytest.approx([2 * EmulatorSettings().pole_com])


def test_two_hundred_periods_pass_without_a_loss(plant: SerialPlant) -> None:
    plant.reset_one()
    cart = plant.cart
    cart.statistics.clear()
    first = cart.get_state()
    for _ in range(200):
        cart.set_motor(0)
        last = cart.get_state()
    assert last.tick == first.tick + 200
    assert last.time_us - first.time_us == 200 * 20_000
    summary = cart.statistics.summary()
    assert [summary[name] for name in ("bad_frames", "lost_frames", "late_ticks")] == [0, 0, 0]
    assert summary["latency_samples"] == 200


def test_an_armed_cart_does_not_take_another_period(plant: SerialPlant) -> None:
    plant.reset_one()
    cart = plant.cart
    cart.statistics.clear()
    with pytest.raises(RefusedError, match=r"refused SET_PERIOD: .*stop it first"):
        cart.set_period(10_000)
    with pytest.raises(RefusedError, match="out of range"):
        cart.stop() or cart.set_period(1)


class TestRefusals:
    """On a scripted cart: what makes re-centring give up, before it moves or after."""

    def test_a_cart_at_the_end_of_the_track(self) -> None:
        with CartPeer() as peer, SerialCart(quick(peer.port)) as cart:
            peer.state = replace(peer.state, cart_counts=peer.info.hard_limit_counts)
            with pytest.raises(NotReadyError, match="stands at the end of the track"):
                recentre(cart, HANGING)
            assert not peer.flags & Flags.ARMED

    def test_a_pole_that_lost_its_zero(self) -> None:
        with CartPeer() as peer, SerialCart(quick(peer.port)) as cart:
            peer.state = replace(peer.state, pole_counts=HANGING + 3 * TURN - 40)
            with pytest.raises(NotReadyError, match=r"rests -3\.5 deg from where it did"):
                recentre(cart, HANGING)
            assert not peer.flags & Flags.ARMED
            recentre(cart, HANGING - 40)

    @pytest.mark.parametrize(
        ("middle", "swing", "reason"),
        [
            (HANGING + 1024, 100, r"swings about a point \+90 deg"),
            (HANGING, 1200, "still swings far after 12"),
        ],
    )
    def test_a_pole_that_cannot_be_braked(self, middle: int, swing: int, reason: str) -> None:
        with CartPeer() as peer, SerialCart(quick(peer.port)) as cart:
            answer = peer.answer

            def swinging(frame: Frame) -> Iterator[bytes]:
                phase = math.tau * peer.state.tick / 60
                pole, cart = round(middle + swing * math.sin(phase)), round(50 * math.sin(phase))
                peer.state = replace(peer.state, pole_counts=pole, cart_counts=cart)
                yield from answer(frame)

            peer.answer = swinging
            with pytest.raises(NotReadyError, match=reason):
                recentre(cart, HANGING)
            assert not peer.flags & Flags.ARMED

    @pytest.mark.parametrize("swing", [0, 400], ids=["centring", "braking"])
    def test_a_count_that_stands_while_the_motor_pushes(self, swing: int) -> None:
        """The cart itself may move: it would hit a stop."""
        with CartPeer() as peer, SerialCart(quick(peer.port)) as cart:
            answer, pushes = peer.answer, []

            def standing(frame: Frame) -> Iterator[bytes]:
                phase = math.tau * peer.state.tick / 60
                pole, dither = round(HANGING + swing * math.sin(phase)), peer.state.tick % 2
                peer.state = replace(peer.state, pole_counts=pole, cart_counts=-2000 + dither)
                pushes.append(abs(peer.state.motor_applied) > 60)
                yield from answer(frame)

            peer.answer = standing
            with pytest.raises(NotReadyError, match="the motor pushes, but the cart's count does not change"):
                recentre(cart, HANGING)
            assert sum(pushes) < 100  # control periods of 20 ms
            assert not peer.flags & Flags.ARMED

    def test_a_fault_on_the_way_is_answered_by_homing(self, caplog: pytest.LogCaptureFixture) -> None:
        with CartPeer() as peer:
            plant = SerialPlant(quick(peer.port))
            plant.reset()
            carry_out = peer.carry_out

            def fail_once(message: object) -> None:
                carry_out(message)
                stalled = type(message).__name__ == "Start"
                peer.state = replace(peer.state, fault=int(Fault.STALL) if stalled else 0)
                if type(message).__name__ == "Home":
                    peer.carry_out = carry_out

            peer.carry_out = fail_once
            assert not plant.reset()["done"]
            assert "homing, as the cart could not be brought back" in caplog.text
            plant.close()

    def test_a_value_that_came_too_late_is_answered_by_homing(self, caplog: pytest.LogCaptureFixture) -> None:
        """As behind a burst of states. In an episode it costs that episode, not all that follow."""
        with CartPeer() as peer, contextlib.closing(SerialPlant(quick(peer.port))) as plant:
            plant.reset()
            answer = peer.answer

            def refuse_once(frame: Frame) -> Iterator[bytes]:
                if not (peer.flags & Flags.ARMED and isinstance(frame.message, SetMotor)):
                    yield from answer(frame)
                    return
                peer.answer = answer
                yield peer.encode(Nack(frame.sequence, SetMotor.TYPE, Reason.STALE))
                yield peer.next_state()

            plant.halt()
            peer.answer = refuse_once
            assert not plant.reset()["done"]
            assert "could not be brought back to the middle: the cart refused SET_MOTOR" in caplog.text
            assert len(peer.messages(Home)) == 2


def quick(port: str) -> SerialSettings:
    return SerialSettings(port=port, timeout=2, answer_timeout=1, nudge_after=0.5)
