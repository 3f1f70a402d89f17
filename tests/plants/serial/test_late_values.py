"""A motor value answers a state that is too old: each place where this computer can pause before it sends."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

import pytest
from serial_peer import CartPeer, Forgetful, quick_settings, wait_for

from cartpole_rl.errors import LinkError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Hello, Nack, Reason, SetMotor, Stop

PERIODS = 15  # a pause; the watchdog waits for three


@pytest.fixture(autouse=True)
def _a_slow_machine_is_not_suspended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SerialCart, "longest_suspension", 60.0)


@contextmanager
def driven() -> Iterator[tuple[CartPeer, SerialCart]]:
    """A cart that is armed and has been driven, and that is known to tick on its own."""
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        cart.get_state()
        idle(peer, cart)
        cart.set_motor(50)
        cart.get_state()
        yield peer, cart


def pause(peer: CartPeer, cart: SerialCart) -> None:
    """Let the cart tick until this computer continues; by then all of its states wait."""
    link = cart._connection.link
    expected = link.waiting() + sum(peer.tick() for _ in range(PERIODS))
    wait_for(lambda: link.waiting() >= expected)


def idle(peer: CartPeer, cart: SerialCart) -> None:
    """Let the cart tick without frames of the host, and read its states."""
    pause(peer, cart)
    cart.get_state()
    assert cart._tracker.ticks_alone


def test_a_motor_value_names_the_state_that_was_handed_out() -> None:
    """Not a newer one that has arrived since: the value does not answer that."""
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.tick()
        answered = cart.get_state().tick
        peer.tick()
        wait_for(lambda: cart._connection.link.waiting() > 0)
        cart._connection._read()
        cart.set_motor(100)
        wait_for(lambda: SetMotor(100, answered) in peer.messages(SetMotor))


def test_a_question_does_not_make_an_old_state_a_new_one() -> None:
    with driven() as (peer, cart):
        answered = cart._tracker.answered_tick
        pause(peer, cart)
        cart.info()
        cart.set_motor(120)
        with pytest.raises(LinkError, match="it answered a state over three periods old"):
            cart.get_state()
        assert peer.messages(SetMotor)[-1] == SetMotor(120, answered)


def test_a_pause_between_the_check_and_the_write() -> None:
    """The cart refuses the value, and the link counts as broken."""
    with driven() as (peer, cart):
        answered = cart._tracker.answered_tick
        pause(peer, cart)
        cart._connection.send_motor(200)  # after the check of `set_motor`
        with pytest.raises(LinkError, match="it answered a state over three periods old"):
            cart.get_state()
        assert peer.messages(SetMotor)[-1] == SetMotor(200, answered)
        assert peer.state.motor_applied == 50
        cart.poll_state()  # it is raised once


def test_a_late_value_that_a_newer_one_overtook_breaks_no_link() -> None:
    with driven() as (peer, cart):
        answer = peer.answer
        peer.answer = lambda frame: ()
        cart.set_motor(200)
        wait_for(lambda: peer.messages(SetMotor)[-1].motor == 200)
        late = peer.received[-1].sequence
        peer.answer = answer
        peer.tick()
        cart.get_state()
        cart.set_motor(100)
        peer.send(peer.encode(Nack(late, SetMotor.TYPE, Reason.STALE)))
        while not cart.took_motor(cart.get_state()):
            peer.tick()
        assert peer.state.motor_applied == 100


def test_a_pause_right_after_a_state_was_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """The state that is handed out is the newest one, not the one that was read before the pause."""
    with driven() as (peer, cart):
        reading, paused, link = threading.Event(), threading.Event(), cart._connection.link
        receive = link.receive

        def receive_and_pause(waiting: int = 0) -> list[Frame]:
            if not waiting:
                reading.set()
            frames = receive(waiting)
            if frames and not waiting and not paused.is_set():
                paused.set()
                pause(peer, cart)
            return frames

        def answer_a_reading_host(frame: Frame) -> list[bytes]:
            reading.wait(20)
            return [*CartPeer.answer(peer, frame)]

        peer.answer = answer_a_reading_host
        monkeypatch.setattr(link, "receive", receive_and_pause)
        cart.set_motor(0)
        assert cart.get_state().tick == peer.state.tick
        assert paused.is_set()


@contextmanager
def lockstep() -> Iterator[tuple[CartPeer, SerialCart]]:
    """A cart that is armed and has been driven, and that ticks for each frame alone."""
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        cart.set_motor(50)
        while cart.get_state().last_sequence != cart._connection.link.sequence:
            pass
        yield peer, cart


def test_a_value_that_was_taken_and_comes_a_second_time_breaks_no_link() -> None:
    with driven() as (peer, cart):
        cart.set_motor(100)
        cart.get_state()
        taken = peer.messages(SetMotor)[-1]
        peer.send(peer.encode(Nack(peer.state.last_sequence, SetMotor.TYPE, Reason.STALE)))
        peer.tick()
        assert cart.get_state().motor_applied == taken.motor == 100


def test_a_value_that_is_late_behind_older_states_is_noticed() -> None:
    """As of a cart that is not known to have its own clock yet, behind a bridge with a backlog."""
    with lockstep() as (peer, cart):

        def tick_before(frame: Frame) -> Iterator[bytes]:
            del peer.answer
            yield b"".join(peer.next_state() for _ in range(8))
            yield from CartPeer.answer(peer, frame)

        peer.answer = tick_before
        cart.set_motor(200)
        with pytest.raises(LinkError, match="it answered a state over three periods old"):
            cart.get_state()
        assert peer.state.motor_applied == 50


def test_a_lockstep_cart_whose_states_are_lost_took_no_value_too_late() -> None:
    """It passes a period for each frame, and no time while this computer pauses."""
    with lockstep() as (peer, cart):

        def lose_two_states(frame: Frame) -> list[bytes]:
            del peer.answer
            [*CartPeer.answer(peer, frame)]
            peer.next_state()
            return [peer.next_state(command_age_ms=2 * 20)]

        peer.answer = lose_two_states
        time.sleep(0.1)  # five periods
        assert cart.set_motor(200) == 200
        while not cart.took_motor(state := cart.get_state()):
            pass
        assert state.motor_applied == 200
        assert not cart._tracker.ticks_alone


def test_a_silent_port_after_a_pause_is_no_proof_that_no_time_has_passed() -> None:
    with driven() as (peer, cart):
        sent = len(peer.messages(SetMotor))
        time.sleep(0.1)  # five periods, and the port has delivered none of them yet
        assert cart.set_motor(200) == 0
        wait_for(lambda: len(peer.messages(SetMotor)) > sent)
        assert peer.messages(SetMotor)[-1].motor == 0


def test_a_cart_that_ticks_on_its_own_gets_no_hello_in_silence() -> None:
    """An accepted frame would let a policy on its board drive on."""
    with driven() as (peer, cart):
        peer.answer = lambda frame: ()
        asked = len(peer.messages(Hello))
        cart.set_motor(0)
        with pytest.raises(LinkError, match="no state came"):
            cart.get_state()
        assert len(peer.messages(Hello)) == asked
        del peer.answer


def test_a_host_that_watches_a_policy_on_the_board_sends_no_hello_in_silence() -> None:
    """It listens before the policy is armed, and so learns whether the cart has a clock of its own."""
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.get_state()
        pause(peer, cart)
        cart.start_policy()
        assert cart._tracker.ticks_alone
        peer.answer = lambda frame: ()
        before, calls = len(peer.messages(Hello)), count(1)

        def watch() -> None:
            while next(calls):
                cart.follow_policy()

        with pytest.raises(LinkError, match="no state came"):
            watch()
        made = next(calls) - 1
        wait_for(lambda: len(peer.messages(Hello)) >= before + made)
        assert len(peer.messages(Hello)) == before + made
        del peer.answer


def test_a_host_whose_first_stop_is_lost_asks_nothing_before_one_is_answered() -> None:
    with Forgetful(Stop, 1) as peer, SerialCart(quick_settings(peer.port)):
        kinds = [type(frame.message) for frame in peer.received]
        assert kinds[: kinds.index(Hello)] == [Stop] * 3  # one was lost, two are acknowledged
