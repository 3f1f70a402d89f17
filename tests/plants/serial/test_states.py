"""States that are lost, repeated, overtaken or answered late, between a host and a scripted cart."""

from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace

import pytest
from serial_peer import CartPeer, Forgetful, quick_settings, wait_for

from cartpole_rl.errors import LinkError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.link import now
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Flags, Hello, SetMotor, Start


def leave_unread(peer: CartPeer, waiting: int, thrown_away: int) -> None:
    """States that nobody reads: some wait, the system had no room for others; then the cart is unpaced."""
    sent = sum(peer.tick() for _ in range(waiting))
    wait_for(lambda: peer.unread() >= sent)
    for _ in range(thrown_away):
        peer.next_state()
    peer.paced = False


@pytest.fixture
def host_clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The host's clock, which can be put `ahead`, s: as if the host had been suspended meanwhile."""
    clock = SimpleNamespace(ahead=0.0)
    for module in ("cart", "connection", "link"):
        monkeypatch.setattr(f"cartpole_rl.plants.serial.{module}.now", lambda: now() + clock.ahead)
    return clock


def test_no_state_from_before_start_is_handed_out(host_clock: SimpleNamespace) -> None:
    class Slow(CartPeer):
        def answer(self, frame: Frame) -> Iterable[bytes]:
            answers = list(super().answer(frame))
            return answers[:1] if isinstance(frame.message, Start) else answers  # no state

    with Slow() as peer, SerialCart(quick_settings(peer.port, timeout=5.0)) as cart:
        cart.start()
        host_clock.ahead = 0.05  # s: the state is overdue
        cart.get_state()
        assert Flags.ARMED in cart.flags


def test_the_newest_of_several_is_returned_and_the_others_are_late() -> None:
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.tick()
        cart.get_state()
        cart.set_motor(10)
        wait_for(lambda: peer.messages(SetMotor)[-1].motor == 10)
        sent = sum(peer.tick(cart_counts=place) for place in (1, 2, 3, 4))
        wait_for(lambda: peer.unread() >= sent)
        assert cart.get_state().cart_counts == 4
        assert cart.statistics.late_ticks == 3
        assert cart.statistics.lost_frames == 0


def test_a_state_from_before_the_command_is_not_taken_for_its_effect() -> None:
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.set_period(100_000)  # long, so that a busy computer does not make the answer overdue
        peer.tick()
        cart.get_state()
        peer.tick(cart_counts=1)  # comes while the host thinks
        peer.answer = lambda frame: [peer.next_state(cart_counts=2, last_sequence=frame.sequence)]
        cart.set_motor(50)
        assert cart.get_state().cart_counts == 2
        assert cart.statistics.late_ticks == 1
        del peer.answer  # it hears the STOP of the end


def test_states_that_did_not_fit_while_the_host_was_busy_are_late_and_not_lost() -> None:
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.set_period(100_000)
        peer.tick()
        cart.get_state()
        cart.set_motor(50)
        wait_for(lambda: peer.state.motor_applied == 50)
        leave_unread(peer, waiting=50, thrown_away=30)
        cart.get_state()
        assert cart.statistics.lost_frames == 0
        assert 80 <= cart.statistics.late_ticks <= 82  # and those that came while this was looked at


def test_states_that_did_not_fit_between_two_episodes_are_neither_lost_nor_late() -> None:
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        peer.tick()
        cart.get_state()
        cart.set_motor(50)
        cart.stop()
        leave_unread(peer, waiting=100, thrown_away=200)
        cart.stop()
        cart.start()
        cart.get_state()
        seen = cart.statistics
        assert (seen.lost_frames, seen.late_ticks) == (0, 0)
        for _ in range(3):
            peer.next_state()  # and these are lost
        cart.poll_state()
        assert seen.lost_frames == 3


def test_an_info_that_makes_no_sense_neither_moves_the_cart_nor_holds_the_loop_up() -> None:
    with CartPeer(paced=True) as peer:
        peer.info = replace(peer.info, period_us=2**32 - 1, motor_limit=-5)
        with SerialCart(quick_settings(peer.port)) as cart:
            assert cart.set_motor(0) == 0
            peer.answer = lambda frame: ()
            cart.set_motor(50)  # is lost
            peer.tick(cart_counts=5, last_sequence=0)
            assert cart.get_state().cart_counts == 5
            del peer.answer


@pytest.mark.parametrize("passed_us", [0, -20_000, -1])
def test_a_clock_that_does_not_advance_with_the_tick_is_refused(passed_us: int) -> None:
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.tick()
        before = cart.get_state()
        peer.tick(time_us=before.time_us + passed_us)
        with pytest.raises(LinkError, match=rf"does not advance: STATE {before.tick} is of"):
            cart.get_state()


def test_states_lost_before_the_first_info_are_no_matter() -> None:
    """A cart that is switched on sends states before anybody asks what it is."""
    with CartPeer(paced=True) as peer:
        answer = CartPeer.answer

        def state_first(frame: Frame) -> Iterable[bytes]:
            yield peer.next_state()
            peer.next_state()  # is lost
            yield peer.next_state()
            yield from answer(peer, frame)

        peer.answer = state_first
        with SerialCart(quick_settings(peer.port)) as cart:
            assert cart.information.motor_limit == 255


def test_a_clock_that_may_have_wrapped_unseen_is_believed() -> None:
    """A person may take an hour to answer a question; nobody reads states meanwhile."""
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        for minutes in (30, 71, 75, 140):
            peer.tick()
            before = cart.get_state()
            ticks = minutes * 60 * 50
            time_us = (before.time_us + ticks * 20_000) % 2**32
            peer.tick(tick=before.tick + ticks, time_us=time_us, cart_counts=minutes)
            assert cart.get_state().cart_counts == minutes


def test_a_command_that_comes_too_late_is_0(host_clock: SimpleNamespace) -> None:
    """The cart would refuse it; newer states wait to be read."""
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port, timeout=10.0)) as cart:
        cart._tracker.ticks_alone = True
        peer.tick()
        cart.get_state()
        peer.tick()
        wait_for(lambda: peer.unread() > 0)
        host_clock.ahead += 0.07
        assert cart.set_motor(200) == 0
        cart.get_state()
        assert cart.set_motor(200) == 200
        peer.tick(last_sequence=peer.state.last_sequence)
        cart.get_state()
        peer.tick()
        wait_for(lambda: peer.unread() > 0)
        host_clock.ahead += 3.0
        with pytest.raises(LinkError, match=r"did not answer the cart on .* for 3\.\d s"):
            cart.set_motor(200)
        assert cart.set_motor(0) == 0
    assert [message.motor for message in peer.messages(SetMotor)] == [0, 0, 200, 0, 0]


def test_time_that_passes_for_the_host_alone_makes_no_command_late(host_clock: SimpleNamespace) -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.get_state()
        host_clock.ahead += 100.0
        assert cart.set_motor(200) == 200


@pytest.mark.parametrize(
    ("on_board", "newer", "seconds"), [(False, False, 600.0), (True, False, 600.0), (True, True, 3.0)]
)
def test_a_computer_that_slept_answers_no_state_from_before(
    host_clock: SimpleNamespace, on_board: bool, newer: bool, seconds: float
) -> None:
    """Nor lets a policy on the board drive on. A newer state may wait already, or the port wakes later."""
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port, timeout=10.0)) as cart:
        cart._tracker.ticks_alone = True
        peer.tick()
        cart.get_state()
        if newer:
            peer.tick()
            wait_for(lambda: peer.unread() > 0)
        greeted = len(peer.messages(Hello))
        host_clock.ahead += seconds
        with pytest.raises(LinkError, match=rf"did not answer the cart on .* for {seconds:.0f}\.\d s"):
            cart.follow_policy() if on_board else cart.set_motor(200)
    assert len(peer.messages(Hello)) == greeted
    assert not any(message.motor for message in peer.messages(SetMotor))


def test_a_state_overtaken_while_opening_is_not_counted_back() -> None:
    with CartPeer() as peer:
        answer = CartPeer.answer
        late: list[bytes] = []

        def lose_one(frame: Frame) -> Iterable[bytes]:
            if not late:
                late.append(peer.next_state())
            yield from answer(peer, frame)

        peer.answer = lose_one
        with SerialCart(quick_settings(peer.port)) as cart:
            cart.statistics.lost_frames = 5
            peer.send(late[0])
            cart.poll_state()
            assert cart.statistics.lost_frames == 5


def test_statistics_of_all_connections_are_kept() -> None:
    """A reconnection adds to them, but neither a boot banner nor what was said before it does."""
    with CartPeer(boot=b"ets Jul 29 2019\r\n\x00", paced=True) as peer:
        with SerialCart(quick_settings(peer.port)) as cart:
            peer.tick()
            peer.tick(tick=peer.state.tick + 3)
            cart.get_state()
            peer.send(b"no frame\x00")
            peer.tick()
            cart.get_state()
        seen = cart.statistics
        first = (seen.lost_frames, seen.bad_frames)
        assert first == (2, 1)
        with cart:
            peer.tick(tick=peer.state.tick + 2)
            cart.get_state()
            peer.tick(tick=peer.state.tick + 2)
            cart.get_state()
        assert (seen.lost_frames, seen.bad_frames) == (3, 1)
        assert cart.statistics is seen


def test_silence_is_broken_by_a_hello() -> None:
    with Forgetful(SetMotor, 0) as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.get_state()
        peer.deaf_to = 1
        hellos = len(peer.messages(Hello))
        cart.set_motor(50)
        cart.get_state()
        assert len(peer.messages(Hello)) == hellos + 1


def test_the_loop_is_timed_by_the_carts_clock() -> None:
    with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.tick()
        cart.get_state()
        for age in (13, 20):
            peer.answer = lambda frame, age=age: [
                peer.next_state(last_sequence=frame.sequence, command_age_ms=age)
            ]
            cart.set_motor(50)
            cart.get_state()
        peer.answer = lambda frame: [peer.next_state(last_sequence=(frame.sequence - 1) % 256)]
        cart.set_motor(50)  # is lost
        cart.get_state()
        assert sorted(cart.statistics.loop_times) == pytest.approx([0, 0.0065])
        del peer.answer  # it hears the STOP of the end
