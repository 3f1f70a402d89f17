"""Preparing an episode on a scripted cart: the pole in its start position, and the control period."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from serial_peer import HANGING, CartPeer, quick_settings
from tensordict import TensorDict

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Start


@pytest.fixture
def peer() -> Iterator[CartPeer]:
    with CartPeer() as peer:
        yield peer


def test_upright_asks_a_person_and_waits_for_the_pole(peer: CartPeer) -> None:
    said: list[str] = []

    def hold(text: str) -> None:
        said.append(text)
        peer.state = replace(peer.state, pole_counts=4096 + 30)  # a turn further is upright too

    plant = SerialPlant(quick_settings(peer.port), start="upright", prompt=hold)
    assert plant.reset()["counts"][0, 1] == 30
    assert "upright" in said[0]
    plant.close()


@pytest.mark.parametrize(
    ("start", "counts", "words"),
    [("upright", 45, r"\+4\.0 deg off: hold it up"), ("hanging", 1900, r"-13\.0 deg off: let it hang")],
)
def test_a_pole_that_is_not_there_is_waited_for_in_vain(
    peer: CartPeer, start: str, counts: int, words: str
) -> None:
    peer.state = replace(peer.state, pole_counts=counts)
    plant = SerialPlant(quick_settings(peer.port, start_timeout=0.05), start, prompt=lambda text: None)
    with pytest.raises(PlantError, match=words):
        plant.reset()
    assert not peer.messages(Start)
    plant.close()


def test_a_cart_that_was_pushed_off_the_middle_does_not_start(peer: CartPeer) -> None:
    """By the hand that lifts the pole. It starts once it is brought back."""

    def push(text: str) -> None:
        peer.state = replace(peer.state, pole_counts=0, cart_counts=-2000)

    plant = SerialPlant(quick_settings(peer.port, start_timeout=0.05), start="upright", prompt=push)
    with pytest.raises(PlantError, match="the cart is -45 mm from the middle of its track: bring it back by"):
        plant.reset()
    assert not peer.messages(Start)
    plant.close()


def test_a_swinging_pole_does_not_start(peer: CartPeer) -> None:
    class Swinging:
        def __init__(self) -> None:
            self.talk, self.side = peer.answer, 1

        def __call__(self, frame: Frame) -> Iterator[bytes]:
            self.side = -self.side
            peer.state = replace(peer.state, pole_counts=HANGING + 30 * self.side)
            yield from self.talk(frame)

    peer.answer = Swinging()
    plant = SerialPlant(quick_settings(peer.port, start_timeout=0.1))
    with pytest.raises(PlantError, match="let it hang until it is still"):
        plant.reset()
    plant.close()


def test_another_control_period_is_set_on_the_cart(peer: CartPeer) -> None:
    plant = SerialPlant(quick_settings(peer.port), control_period=0.01)
    plant.reset()
    assert peer.info.period_us == 10_000
    motor = torch.zeros(1, 1, dtype=torch.int64)
    assert plant.step(TensorDict({"motor": motor}, [1]))["next", "dt"].item() == pytest.approx(0.01)
    peer.info = replace(peer.info, period_us=20_000)  # as after a restart
    plant.reset()
    assert peer.info.period_us == 10_000
    plant.close()
