"""Between episodes the emulated cart is brought back to the middle, and homed where that will not do."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from serial_peer import HANGING, CartPeer
from tensordict import TensorDict

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import NotReadyError
from cartpole_rl.plants.serial.moves import recentre
from cartpole_rl.plants.serial.plant import SerialPlant, emulated_plant
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Fault, Flags

TURN = 4096
MIDDLE = 100  # counts, 2.3 mm
HOMING = 20.0  # s; no homing is done sooner, no re-centring of the default cart takes so long
fast = partial(EmulatorSettings, physics_step=1e-3)


def push(plant: SerialPlant, motor: int) -> TensorDict:
    return plant.step(TensorDict({"motor": torch.full((1, 1), motor)}, [1]))["next"]


def swing_up(plant: SerialPlant, steps: int = 90, half_swing: int = 12) -> None:
    """Wild but within the track: the pole is left turning or swinging far, the cart off the middle."""
    motor = 200
    for step in range(steps):
        counts = push(plant, motor)["counts"][0, 0].item()
        if step % half_swing == 0:
            motor = -motor
        if abs(counts) > 5000:
            motor = -200 if counts > 0 else 200
    assert plant.ended_by == ""


def reset(plant: SerialPlant) -> tuple[float, TensorDict]:
    """Seconds that a reset takes by the cart's clock, and the first frame."""
    before = plant.cart.poll_state().time_us
    plant.cart.statistics.latency.clear()
    frame = plant.reset()
    return (plant.cart.poll_state().time_us - before) * 1e-6, frame


def hangs_in_the_middle(frame: TensorDict) -> bool:
    cart, pole = frame["counts"][0].tolist()
    return abs(cart) < MIDDLE and abs(pole - TURN // 2) < 16


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
        homing, frame = reset(plant)
        assert hangs_in_the_middle(frame)
        swing_up(plant)
        plant.halt()
        seconds, frame = reset(plant)
        assert hangs_in_the_middle(frame)
        assert seconds < 0.6 * homing
        assert not frame["done"]


@pytest.mark.parametrize("period", [0.01, 0.1])
def test_other_control_periods(period: float) -> None:
    with contextlib.closing(emulated_plant(fast(), period)) as plant:
        plant.reset()
        swing_up(plant, round(1.8 / period), max(1, round(0.24 / period)))
        plant.halt()
        seconds, frame = reset(plant)
        assert hangs_in_the_middle(frame)
        assert seconds < HOMING


def test_moves_of_the_host_are_no_latencies_of_the_policy(plant: SerialPlant) -> None:
    plant.reset()
    swing_up(plant)
    seconds, _ = reset(plant)
    assert seconds < HOMING
    assert plant.cart.statistics.summary()["latency_samples"] == 0
    push(plant, 0)
    assert plant.cart.statistics.summary()["latency_samples"] == 1


def test_rehome_always_homes_each_time() -> None:
    with contextlib.closing(emulated_plant(fast(), rehome="always")) as plant:
        for _ in range(2):
            seconds, frame = reset(plant)
            assert seconds > HOMING
            assert hangs_in_the_middle(frame)
            push(plant, 100)


def test_a_cart_that_has_restarted_is_homed() -> None:
    with contextlib.closing(emulated_plant(fast(reset_at=26.0))) as plant:
        plant.reset()
        for _ in range(150):
            if push(plant, 0)["done"]:
                break
        assert plant.ended_by == "link"
        plant.reset()
        assert plant.cart.poll_state().time_us > HOMING * 1e6
        assert plant.cart.flags & Flags.HOMED


def test_whole_turns_of_the_pole_do_not_add_up(plant: SerialPlant) -> None:
    for _ in range(2):
        _, frame = reset(plant)
        assert hangs_in_the_middle(frame)
        swing_up(plant, 150)


def test_disturbed_frames_do_not_hinder_it() -> None:
    disturbed = fast(frame_loss=0.03, frame_corruption=0.03, frame_reordering=0.03, frame_duplication=0.03)
    with contextlib.closing(emulated_plant(disturbed)) as plant:
        plant.reset()
        swing_up(plant)
        _, frame = reset(plant)
        assert hangs_in_the_middle(frame)
        seen = plant.cart.statistics.summary()
        assert min(seen[f"{name}_frames"] for name in ("overtaken", "repeated", "lost")) > 5


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


def quick(port: str) -> SerialSettings:
    return SerialSettings(port=port, timeout=2, answer_timeout=1, nudge_after=0.5)
