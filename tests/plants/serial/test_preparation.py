"""Preparing an episode on a scripted cart: the pole in its start position, and the control period."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import cycle

import pytest
from serial_peer import HANGING, CartPeer, quick_settings

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.serial.preparation import StartPosition
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Start


def test_upright_asks_a_person_and_waits_for_the_pole(peer: CartPeer) -> None:
    said: list[str] = []

    def hold(text: str) -> None:
        said.append(text)
        peer.state = replace(peer.state, pole_counts=4096 + 30)  # a turn further is upright too

    with closing(SerialPlant(quick_settings(peer.port), start="upright", prompt=hold)) as plant:
        assert plant.reset()["counts"][0, 1] == 30
    assert "upright" in said[0]


def check_waited_in_vain(
    peer: CartPeer, words: str, start: StartPosition = "hanging", prompt: Callable[[str], None] = print
) -> None:
    """Check that a reset gives up for the reason `words`, and does not arm the cart."""
    settings = quick_settings(peer.port, start_timeout=0.05)
    with (
        closing(SerialPlant(settings, start, prompt=prompt)) as plant,
        pytest.raises(PlantError, match=words),
    ):
        plant.reset()
    assert not peer.messages(Start)


@pytest.mark.parametrize(
    ("start", "counts", "words"),
    [("upright", 45, r"\+4\.0 deg off: hold it up"), ("hanging", 1900, r"-13\.0 deg off: let it hang")],
)
def test_a_pole_that_is_not_there_is_waited_for_in_vain(
    peer: CartPeer, start: StartPosition, counts: int, words: str
) -> None:
    peer.state = replace(peer.state, pole_counts=counts)
    check_waited_in_vain(peer, words, start)


def test_a_cart_that_was_pushed_off_the_middle_does_not_start(peer: CartPeer) -> None:
    """By the hand that lifts the pole. It starts once it is brought back."""

    def push(text: str) -> None:
        peer.state = replace(peer.state, pole_counts=0, cart_counts=-2000)

    words = "the cart is -45 mm from the middle of its track: bring it back by"
    check_waited_in_vain(peer, words, "upright", push)


def test_a_swinging_pole_does_not_start(peer: CartPeer) -> None:
    talk, sides = peer.answer, cycle((-30, 30))

    def swinging(frame: Frame) -> Iterator[bytes]:
        peer.state = replace(peer.state, pole_counts=HANGING + next(sides))
        yield from talk(frame)

    peer.answer = swinging
    check_waited_in_vain(peer, "let it hang until it is still")


def test_another_control_period_is_set_on_the_cart(peer: CartPeer) -> None:
    with closing(SerialPlant(quick_settings(peer.port), control_period=0.01)) as plant:
        plant.reset()
        assert peer.info.period_us == 10_000
        assert plant.step_one(0).dt == pytest.approx((0.01,))
        peer.info = replace(peer.info, period_us=20_000)  # as after a restart
        plant.reset()
        assert peer.info.period_us == 10_000
