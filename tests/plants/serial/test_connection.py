"""Questions and answers between the host and a scripted cart: repetitions, refusals, faults."""

import re
import threading
from dataclasses import replace

import pytest
from serial_peer import CartPeer, Forgetful, Refusing, quick_settings

from cartpole_rl.errors import FaultError, LinkError, PlantError
from cartpole_rl.plants.serial import connection
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import RefusedError
from cartpole_rl.wire import Fault, Flags, Nack, Reason, SetMotor, Start, Stop


def test_a_question_that_was_lost_is_repeated() -> None:
    with Forgetful(Start, 1) as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        assert len(peer.messages(Start)) == 2


def test_a_question_that_is_never_answered() -> None:
    with Forgetful(Start, 99) as peer, SerialCart(quick_settings(peer.port)) as cart:
        with pytest.raises(LinkError, match="did not answer START, asked 2 times"):
            cart.start()
        assert len(peer.messages(Start)) == 2


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        (Reason.NOT_HOMED, "START: it is not homed"),
        (Reason.BUSY, "START: it is armed or homing"),
        (99, "START: reason 99, unknown here"),
    ],
)
def test_a_refusal_says_why(reason: int, words: str) -> None:
    with Refusing(Start, reason) as peer, SerialCart(quick_settings(peer.port)) as cart:
        with pytest.raises(RefusedError, match=words) as caught:
            cart.start()
        assert caught.value.reason == reason
        began = len(peer.received)
        assert cart.get_state()  # a refused frame is never acknowledged, and not waited for
        assert len(peer.received) == began


def test_a_refusal_for_a_fault_is_a_fault() -> None:
    with Refusing(Start, Reason.FAULT_LATCHED) as peer, SerialCart(quick_settings(peer.port)) as cart:
        with pytest.raises(FaultError, match="a fault is latched: remove its cause"):
            cart.start()
        assert not peer.flags & Flags.ARMED


def test_a_refused_motor_value_is_raised_where_the_state_is_read() -> None:
    with Refusing(SetMotor, Reason.NOT_ARMED) as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.set_motor(10)
        with pytest.raises(RefusedError, match=re.escape("not armed; has it restarted?")):
            cart.get_state()
        assert cart.get_state()


@pytest.mark.parametrize("accepted", [10, 140, 300])
def test_a_refusal_is_raised_at_once_however_many_values_were_accepted(accepted: int) -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        for _ in range(accepted):
            cart.set_motor(50)
            cart.get_state()
        peer.answer = lambda frame: [
            peer.encode(Nack(frame.sequence, SetMotor.TYPE, Reason.NOT_ARMED)),
            peer.next_state(),
        ]
        cart.set_motor(50)
        with pytest.raises(RefusedError, match="not armed"):
            cart.get_state()
        peer.answer = lambda frame: CartPeer.answer(peer, frame)


def test_a_cart_that_hears_nothing_is_a_lost_link(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "LONGEST_DEAFNESS", 0.2)
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.tick()
        cart.start()
        peer.tick()
        cart.get_state()
        peer.answer = lambda frame: ()  # the wire to the cart is broken, the one from it is not

        def drive_on() -> None:
            for _ in range(1000):
                cart.set_motor(50)
                peer.tick()
                cart.get_state()

        with pytest.raises(LinkError, match="sends states but acknowledges nothing: check the wire from"):
            drive_on()
        peer.answer = lambda frame: CartPeer.answer(peer, frame)


def test_a_device_that_never_pauses_does_not_hold_up_the_host() -> None:
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port, timeout=0.3)) as cart:
        stopped = threading.Event()

        def flood() -> None:
            while not stopped.is_set():
                peer.send(b"noise " * 100)

        flooding = threading.Thread(target=flood)
        flooding.start()
        try:
            with pytest.raises(LinkError, match="no state came"):
                cart.get_state()
        finally:
            stopped.set()
            while flooding.is_alive():  # it may wait for room
                peer.unread() and cart._connection.link.receive(peer.unread())
            flooding.join()


def test_a_refusal_of_what_was_sent_before_the_last_question_is_void() -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        cart.set_motor(50)
        cart.get_state()
        cart.stop()
        before = next(frame for frame in reversed(peer.received) if isinstance(frame.message, SetMotor))
        peer.send(peer.encode(Nack(before.sequence, SetMotor.TYPE, Reason.NOT_ARMED)))
        assert cart.poll_state()  # the frames of the STOP changed places on their way


def test_a_state_with_a_fault_is_returned_rather_than_raised() -> None:
    with Refusing(SetMotor, Reason.FAULT_LATCHED) as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.state = replace(peer.state, fault=int(Fault.STALL))
        cart.set_motor(10)
        assert cart.get_state().fault == Fault.STALL


def test_a_fault_that_stays_is_named_with_its_remedy() -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.clear_fault()
        peer.state = replace(peer.state, fault=int(Fault.POLE_ENCODER | Fault.STALL) | 0x8000)
        with pytest.raises(FaultError, match=r"motor's supply.*pole's encoder.*check its cable.*0x8000"):
            cart.clear_fault()


def test_a_homing_that_fails_names_the_fault() -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.state = replace(peer.state, fault=int(Fault.HOMING))
        with pytest.raises(FaultError, match="homing failed"):
            cart.home()


def test_a_homing_that_does_not_end() -> None:
    with (
        CartPeer() as peer,
        SerialCart(quick_settings(peer.port, nudge_after=0.01, home_timeout=0.1)) as cart,
    ):
        peer.carry_out = lambda message: setattr(peer, "flags", Flags.HOMING)
        with pytest.raises(PlantError, match=r"not done after 0\.1 s"):
            cart.home()
        assert isinstance(peer.received[-1].message, Stop)


def test_the_period_is_set_and_known() -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        assert cart.set_period(10_000).period_us == 10_000
        assert cart.information.period_us == 10_000
