"""Questions and answers between the host and a scripted cart: repetitions, refusals, faults."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import pytest
from serial_peer import CartPeer, Forgetful, HomingForever, Refusing, quick_settings

from cartpole_rl.errors import FaultError, LinkError, PlantError
from cartpole_rl.plants.serial import connection
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import RefusedError
from cartpole_rl.plants.serial.link import SerialLink
from cartpole_rl.wire.frames import END, Frame, crc16, stuff, unstuff
from cartpole_rl.wire.messages import (
    Ack,
    Fault,
    Flags,
    Hello,
    Home,
    Message,
    Nack,
    Reason,
    SetMotor,
    Start,
    StartPolicy,
    State,
    Stop,
)


def test_a_question_that_was_lost_is_repeated() -> None:
    with Forgetful(Start, 1) as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        assert len(peer.messages(Start)) == 2


class LeftOver(CartPeer):
    """Hears no STOP; answers each with the next acknowledgement that is left over from the last host."""

    def __init__(self, left_over: Callable[[Frame], Ack | None]) -> None:
        super().__init__()
        self.left_over = left_over

    def answer(self, frame: Frame) -> Iterable[bytes]:
        ack = self.left_over(frame) if isinstance(frame.message, Stop) else None
        if ack is not None:
            yield self.encode(ack)


def acks(*made: Ack) -> Callable[[Frame], Ack | None]:
    left = iter(made)
    return lambda frame: next(left, None)


@pytest.mark.parametrize(
    "left_over",
    [
        lambda frame: Ack(frame.sequence, Hello.TYPE),
        lambda frame: Ack(frame.sequence, Start.TYPE),
        lambda frame: Ack((frame.sequence + 100) % 256, Stop.TYPE),
        acks(*(Ack(sequence, Stop.TYPE) for sequence in range(1, 6))),
        acks(Ack(101, Stop.TYPE)),
    ],
    ids=["HELLO", "START", "sequence", "first of a host", "fits by chance"],
)
def test_an_acknowledgement_of_the_last_host_is_not_taken_for_that_of_stop(
    left_over: Callable[[Frame], Ack | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy of a host that died may still be armed; HELLO would wake it. Here nothing stopped it."""
    monkeypatch.setattr("cartpole_rl.plants.serial.link.os.urandom", lambda size: bytes([100] * size))
    with LeftOver(left_over) as peer:
        with pytest.raises(LinkError, match="no cart answers"):
            SerialCart(quick_settings(peer.port, connect_timeout=1.0)).open()
        assert len(peer.messages(Stop)) > 2
        assert not peer.messages(Hello)


def test_a_host_begins_with_any_sequence() -> None:
    """So the acknowledgements of the last one do not fit its own frames."""
    firsts = set()
    for _ in range(5):
        with CartPeer() as peer, SerialCart(quick_settings(peer.port)):
            firsts.add(peer.received[0].sequence)
    assert len(firsts) > 1


def frames_of_version(version: int, frames: Iterable[bytes]) -> Iterator[bytes]:
    """The frames as a cart of another protocol version sends them."""
    for frame in frames:
        body = bytes([version]) + unstuff(frame[:-1])[1:-2]
        yield stuff(body + crc16(body).to_bytes(2, "little")) + END


class OldCart(CartPeer):
    """A cart of protocol version 1, which refuses every frame of another one."""

    def answer(self, frame: Frame) -> Iterable[bytes]:
        refusal = self.encode(Nack(frame.sequence, frame.message.TYPE, Reason.BAD_VERSION))
        yield from frames_of_version(1, [refusal, self.next_state()])


def test_a_cart_of_another_version_is_told_in_one_line() -> None:
    with OldCart() as peer:
        with pytest.raises(LinkError) as told:
            SerialCart(quick_settings(peer.port, connect_timeout=0.5)).open()
        assert str(told.value) == (
            f"no cart answers on {peer.port}: it speaks protocol version 1, this program 2: update its "
            "firmware, or this program"
        )
        assert not peer.messages(Hello)
        assert not any(message.motor for message in peer.messages(SetMotor))


@pytest.mark.parametrize(
    ("ask", "reason", "error", "words"),
    [
        (Start, Reason.NOT_HOMED, RefusedError, "START: it is not homed"),
        (Start, Reason.BUSY, RefusedError, "START: it is armed or homing"),
        (Start, 99, RefusedError, "START: reason 99, unknown here"),
        (Start, Reason.FAULT_LATCHED, FaultError, "a fault is latched: remove its cause"),
        (StartPolicy, Reason.UNKNOWN_TYPE, RefusedError, "refused START_POLICY: its board has no policy"),
    ],
)
def test_a_refusal_says_why(ask: type[Message], reason: int, error: type[PlantError], words: str) -> None:
    with Refusing(ask, reason) as peer, SerialCart(quick_settings(peer.port)) as cart:
        with pytest.raises(error, match=words) as caught:
            cart.start() if ask is Start else cart.start_policy()
        assert getattr(caught.value, "reason", reason) == reason
        assert not peer.flags & Flags.ARMED
        began = len(peer.received)
        assert cart.get_state()  # a refused frame is never acknowledged, and not waited for
        assert len(peer.received) == began


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
        del peer.answer


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
        del peer.answer


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


def test_a_homing_that_does_not_end() -> None:
    with (
        CartPeer() as peer,
        SerialCart(quick_settings(peer.port, nudge_after=0.01, home_timeout=0.1)) as cart,
    ):
        peer.carry_out = lambda message: setattr(peer, "flags", Flags.HOMING)
        with pytest.raises(PlantError, match=r"not done after 0\.1 s"):
            cart.home()
        assert isinstance(peer.received[-1].message, Stop)


def test_a_cart_that_homes_is_asked_ten_times_a_second_of_its_own_clock() -> None:
    with HomingForever() as peer, SerialCart(quick_settings(peer.port)) as cart:
        asked: list[int] = []

        def watch(state: State) -> None:
            asked.append(len(peer.messages(Hello)))
            if state.tick < 300:
                peer.tick()
            else:
                peer.flags = Flags.HOMED

        began = peer.state.tick
        cart.home(watch)
        periods = peer.state.tick - began
        assert 0.1 * periods < asked[-1] - asked[0] <= 0.2 * periods + 1


def test_a_cart_that_ended_its_homing_by_itself_is_a_lost_link() -> None:
    with HomingForever() as peer, SerialCart(quick_settings(peer.port)) as cart:

        def end(state: State) -> None:
            peer.flags = Flags(0)
            peer.tick()

        with pytest.raises(LinkError, match="ended homing, as no frame of this computer reached it"):
            cart.home(end)


def test_the_policy_on_the_board_has_to_be_the_agent_that_is_asked_for() -> None:
    with CartPeer() as peer:
        with SerialCart(quick_settings(peer.port)) as cart, pytest.raises(PlantError, match="has no policy"):
            cart.check_policy(0x1A2B3C4D)
        peer.info = replace(peer.info, policy=0x1A2B3C4D)
        with SerialCart(quick_settings(peer.port)) as cart:
            cart.check_policy(0x1A2B3C4D)
            with pytest.raises(
                PlantError, match=r"has another agent \(1a2b3c4d, not 00000005\), or one for a pole"
            ):
                cart.check_policy(5)
        assert not peer.flags & Flags.ARMED


@pytest.mark.parametrize("reopens", [False, True])
def test_another_agent_on_a_board_that_came_later_does_not_drive(reopens: bool) -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        peer.info = replace(peer.info, policy=17)
        cart.info()
        cart.check_policy(17)
        cart.start_policy()
        cart.stop()
        peer.info = replace(peer.info, policy=18)
        if reopens:
            cart.close()
        with pytest.raises(PlantError, match=r"another agent \(00000012, not 00000011\)"):
            cart.open() if reopens else cart.start_policy()
        assert not peer.flags & Flags.ARMED
        assert len(peer.messages(StartPolicy)) == 1


class Busy(CartPeer):
    """Refuses the first HOMEs; if it is `late`, the first one starts, and its ACK comes with the second."""

    def __init__(self, refusals: int, late: bool) -> None:
        super().__init__()
        self.refusals, self.late, self.held = refusals, late, ()

    def answer(self, frame: Frame) -> Iterable[bytes]:
        if not isinstance(frame.message, Home) or not self.refusals:
            yield from super().answer(frame)
            return
        self.refusals -= 1
        if self.late and not self.held:
            self.held = (*super().answer(frame),)
            return
        yield from self.held
        yield self.encode(Nack(frame.sequence, Home.TYPE, Reason.BUSY))


@pytest.mark.parametrize(("refusals", "late", "asked"), [(2, True, 2), (3, False, 4)])
def test_home_is_repeated_while_the_brake_acts_and_ends_if_only_its_acknowledgement_was_late(
    refusals: int, late: bool, asked: int
) -> None:
    """No state acknowledges a repetition that is refused."""
    with Busy(refusals, late) as peer, SerialCart(quick_settings(peer.port)) as cart:
        assert cart.home().tick
        assert len(peer.messages(Home)) == asked


class Distant(CartPeer):
    """Answers each STOP, or every frame, `delay` s later."""

    delay, to = 0.0, Stop

    def answer(self, frame: Frame) -> Iterable[bytes]:
        held = [*super().answer(frame)]
        if isinstance(frame.message, self.to):
            time.sleep(self.delay)
        yield from held


def test_a_link_without_states_in_time_is_measured_before_the_cart_is_armed() -> None:
    """No state tells whether the cart has a clock of its own."""
    with Distant(paced=True) as peer:
        peer.delay, peer.to = 0.05, Message
        with SerialCart(quick_settings(peer.port, answer_timeout=0.5)) as cart:
            with pytest.raises(LinkError, match="over a period of 20 ms"):
                cart.start()
            assert not peer.messages(Start)


@pytest.mark.parametrize("begin", [SerialCart.home, SerialCart.start, SerialCart.start_policy])
def test_a_link_that_takes_over_a_period_drives_no_cart(begin: Callable[[SerialCart], object]) -> None:
    with Distant() as peer, SerialCart(quick_settings(peer.port, answer_timeout=5.0)) as cart:
        cart.set_period(5_000)
        cart._tracker.ticks_alone = True
        peer.delay = 0.02
        with pytest.raises(LinkError, match=r"takes 2\d ms|takes \d{2,} ms, over a period of 5 ms"):
            begin(cart)
        assert not peer.messages(Home) + peer.messages(Start) + peer.messages(StartPolicy)


def test_on_a_lockstep_cart_no_time_passes_on_the_way() -> None:
    with Distant() as peer, SerialCart(quick_settings(peer.port, answer_timeout=5.0)) as cart:
        peer.delay = 0.05
        stopped = len(peer.messages(Stop))
        cart.start()
        assert len(peer.messages(Stop)) == stopped


def test_a_cart_whose_states_failed_to_come_at_first_is_no_lockstep_cart() -> None:
    """It is looked at once more before it is armed."""
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        assert cart.is_lockstep
        peer.paced, ended = True, threading.Event()

        def tick() -> None:
            while not ended.wait(0.02):
                peer.tick()

        ticking = threading.Thread(target=tick)
        ticking.start()
        try:
            stopped = len(peer.messages(Stop))
            cart.start()
            assert not cart.is_lockstep
            assert len(peer.messages(Stop)) > stopped  # the round trip was measured
        finally:
            ended.set()
            ticking.join()


def test_a_device_that_never_pauses_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its bytes always wait, and none of them is an answer."""
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        monkeypatch.setattr(SerialLink, "waiting", lambda link: 1000)
        monkeypatch.setattr(SerialLink, "receive", lambda link, waiting=0: [])
        with pytest.raises(LinkError, match="did not answer STOP"):
            cart.stop()
        monkeypatch.undo()
