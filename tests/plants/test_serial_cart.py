import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import pytest
from serial_peer import CartPeer, Peer, open_descriptors

from cartpole_rl.errors import FaultError, LinkError, PlantError, PortError
from cartpole_rl.plants.serial.cart import SerialCart, SerialSettings
from cartpole_rl.plants.serial.errors import RefusedError
from cartpole_rl.plants.serial.port import why_not_open
from cartpole_rl.wire import Fault, Flags, Frame, Hello, Nack, Reason, SetMotor, Start, Stop


def settings(port: str, **changes: float) -> SerialSettings:
    quick = {"timeout": 0.4, "connect_timeout": 2.0, "answer_timeout": 0.2, "retries": 1, "nudge_after": 0.1}
    return SerialSettings(port=port, **(quick | changes))


def leave_unread(peer: CartPeer, cart: SerialCart, waiting: int, thrown_away: int) -> None:
    """States that nobody reads: some wait, the system had no room for others; then the cart is unpaced."""
    for _ in range(waiting):
        peer.tick()
    wait_for(lambda: cart._link.waiting() > 30 * waiting)
    for _ in range(thrown_away):
        peer.next_state()
    peer.paced = False


class Refusing(CartPeer):
    """Refuses messages of one type with one reason."""

    def __init__(self, kind: type, reason: int) -> None:
        super().__init__()
        self.kind, self.reason = kind, reason

    def answer(self, frame: Frame) -> Iterable[bytes]:
        if isinstance(frame.message, self.kind):
            yield self.encode(Nack(frame.sequence, frame.message.TYPE, self.reason))
            yield self.next_state()
        else:
            yield from super().answer(frame)


class Forgetful(CartPeer):
    """Does not hear the first `deaf_to` messages of one type."""

    def __init__(self, kind: type, deaf_to: int) -> None:
        super().__init__()
        self.kind, self.deaf_to = kind, deaf_to

    def answer(self, frame: Frame) -> Iterable[bytes]:
        if isinstance(frame.message, self.kind) and self.deaf_to:
            self.deaf_to -= 1
            return
        yield from super().answer(frame)


class TestOpening:
    def test_information_is_known_and_the_cart_is_disarmed(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            assert cart.information == peer.info
            assert cart.info() == peer.info
            assert peer.messages(Stop)

    def test_a_boot_banner_and_noise_are_passed_over(self) -> None:
        boot = b"ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET)\x00\x07\x01\x00" + bytes(range(256)) * 3
        with CartPeer(boot) as peer, SerialCart(settings(peer.port)) as cart:
            assert cart.get_state().pole_counts == 2048
            assert cart.statistics.bad_frames == 0

    def test_noise_between_frames_is_counted_and_passed_over(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.send(b"\x05noise\x00" + b"y" * 500 + b"\x00")
            peer.tick(cart_counts=7)
            assert cart.get_state().cart_counts == 7
            assert cart.statistics.bad_frames == 2

    def test_a_port_that_does_not_exist(self) -> None:
        with pytest.raises(PortError, match=r"/dev/nosuch0 does not exist: plug the cart in"):
            SerialCart(settings("/dev/nosuch0")).open()

    def test_a_busy_port(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            with pytest.raises(PortError, match=f"{peer.port} is busy"):
                SerialCart(settings(peer.port)).open()
            assert cart.get_state()

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may open every file")
    def test_a_port_that_may_not_be_opened(self) -> None:
        with CartPeer() as peer:
            Path(peer.port).chmod(0)
            with pytest.raises(PortError, match="dialout"):
                SerialCart(settings(peer.port)).open()

    def test_the_word_for_missing_permission(self) -> None:
        assert "dialout" in why_not_open("/dev/ttyUSB0", PermissionError(13, "Permission denied"))

    def test_a_file_that_is_no_port(self, tmp_path) -> None:
        path = tmp_path / "plain.txt"
        path.write_text("no cart")
        with pytest.raises(PortError, match="cannot be opened as a serial port"):
            SerialCart(settings(str(path))).open()

    def test_an_unknown_kind_of_url(self) -> None:
        with pytest.raises(PortError, match="nosuch://"):
            SerialCart(settings("nosuch://there")).open()

    def test_a_silent_device(self) -> None:
        with Peer() as peer:
            began = open_descriptors()
            with pytest.raises(LinkError, match="nothing came"):
                SerialCart(settings(peer.port, connect_timeout=0.5)).open()
            assert open_descriptors() == began
            assert peer.messages(Hello)

    def test_a_device_that_speaks_something_else(self) -> None:
        class Chatter(Peer):
            def answer(self, frame: Frame) -> Iterable[bytes]:
                return (b"ok T:20.4\x00",)

        with (
            Chatter() as peer,
            pytest.raises(LinkError, match=r"bytes came, the last bad frame: .*right baud"),
        ):
            SerialCart(settings(peer.port, connect_timeout=0.5)).open()

    def test_methods_need_an_open_port(self) -> None:
        with pytest.raises(LinkError, match="is not open"):
            SerialCart(settings("/dev/ttyUSB0")).get_state()


class TestMotor:
    @pytest.mark.parametrize(("asked", "sent"), [(100, 100), (0, 0), (256, 255), (-9999, -255)])
    def test_what_is_sent_is_within_the_limit_and_returned(self, asked: int, sent: int) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            assert cart.set_motor(asked) == sent
            assert cart.get_state().motor_applied == sent
            assert peer.messages(SetMotor)[-1] == SetMotor(sent)

    def test_the_cart_itself_sets_the_limit(self) -> None:
        with CartPeer() as peer:
            peer.info = peer.info.__class__(1, 2, 3, 4096, 22749, 180, 14000, 17000, 20000)
            with SerialCart(settings(peer.port)) as cart:
                assert cart.set_motor(255) == 180

    @pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
    def test_every_way_out_stops_the_motor(self, error: type[BaseException]) -> None:
        with CartPeer() as peer:
            with pytest.raises(error), SerialCart(settings(peer.port)) as cart:
                drive_and_fail(cart, error)
            assert [type(frame.message) for frame in peer.received[-2:]] == [SetMotor, Stop]
            assert peer.state.motor_applied == 0
            assert not peer.flags & Flags.ARMED

    def test_the_first_error_is_the_one_that_is_seen_on_a_dead_link(self) -> None:
        with CartPeer() as peer, pytest.raises(ZeroDivisionError), SerialCart(settings(peer.port)) as cart:
            drive_and_fail(cart, ZeroDivisionError, peer.unplug)


class TestStates:
    def test_the_newest_of_several_is_returned_and_the_others_are_late(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.tick()
            cart.get_state()
            cart.set_motor(10)
            wait_for(lambda: peer.messages(SetMotor)[-1] == SetMotor(10))
            for place in (1, 2, 3, 4):
                peer.tick(cart_counts=place)
            wait_for(lambda: cart._link.waiting() > 80)
            assert cart.get_state().cart_counts == 4
            assert cart.statistics.late_ticks == 3
            assert cart.statistics.lost_frames == 0

    def test_a_state_from_before_the_command_is_not_taken_for_its_effect(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            cart.set_period(100_000)  # long, so that a busy computer does not make the answer overdue
            peer.tick()
            cart.get_state()
            peer.tick(cart_counts=1)  # comes while the host thinks
            peer.answer = lambda frame: [peer.next_state(cart_counts=2, last_sequence=frame.sequence)]
            cart.set_motor(50)
            assert cart.get_state().cart_counts == 2
            assert cart.statistics.late_ticks == 1

    def test_a_command_that_is_lost_does_not_hold_the_loop_up(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port, nudge_after=10)) as cart:
            peer.answer = lambda frame: ()
            cart.set_motor(50)
            peer.tick(cart_counts=5)
            assert cart.get_state().cart_counts == 5
            assert cart.statistics.late_ticks == 0

    def test_a_command_later_than_a_period_is_late_and_so_is_the_state_that_it_passed_over(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            cart.set_period(40_000)
            peer.tick()
            cart.get_state()
            time.sleep(0.05)
            peer.tick()  # comes while the host is busy
            peer.answer = lambda frame: [peer.next_state(last_sequence=frame.sequence)]
            cart.set_motor(50)
            assert cart.get_state().tick == 3
            assert cart.statistics.late_ticks == 2
            cart.set_motor(50)  # at once
            cart.get_state()
            assert cart.statistics.late_ticks == 2

    def test_a_late_command_counts_though_the_state_meanwhile_was_lost(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            cart.set_period(5_000)
            peer.tick()
            cart.get_state()
            time.sleep(0.02)
            peer.next_state()  # is lost
            peer.answer = lambda frame: [peer.next_state(last_sequence=frame.sequence)]
            cart.set_motor(50)
            cart.get_state()
            assert (cart.statistics.late_ticks, cart.statistics.lost_frames) == (1, 1)

    def test_a_cart_that_waits_for_the_host_is_never_answered_late(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            cart.set_period(5_000)
            cart.get_state()
            time.sleep(0.02)
            cart.set_motor(50)
            cart.get_state()
            assert cart.statistics.late_ticks == 0
            assert cart.statistics.summary().latency_max_ms > 20

    def test_states_that_did_not_fit_while_the_host_was_busy_are_late_and_not_lost(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            cart.set_period(100_000)
            peer.tick()
            cart.get_state()
            cart.set_motor(50)
            wait_for(lambda: bool(peer.messages(SetMotor)))
            leave_unread(peer, cart, waiting=50, thrown_away=30)
            cart.get_state()
            assert cart.statistics.lost_frames == 0
            assert 80 <= cart.statistics.late_ticks <= 82  # and those that came while this was looked at

    def test_a_long_pause_does_not_bring_up_the_past(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            for place in range(100):
                peer.tick(cart_counts=place)
            wait_for(lambda: cart._link.waiting() > 2000)
            peer.paced = False
            assert cart.get_state().tick == peer.state.tick
            assert cart.statistics.lost_frames == 0

    def test_states_that_did_not_fit_between_two_episodes_are_neither_lost_nor_late(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            cart.start()
            peer.tick()
            cart.get_state()
            cart.set_motor(50)
            cart.stop()
            leave_unread(peer, cart, waiting=100, thrown_away=200)
            cart.stop()
            cart.start()
            cart.get_state()
            seen = cart.statistics
            assert (seen.lost_frames, seen.late_ticks) == (0, 0)
            for _ in range(3):
                peer.next_state()  # and these are lost
            cart.poll_state()
            assert seen.lost_frames == 3

    def test_an_info_that_makes_no_sense_neither_moves_the_cart_nor_holds_the_loop_up(self) -> None:
        with CartPeer(paced=True) as peer:
            peer.info = replace(peer.info, period_us=2**32 - 1, motor_limit=-5)
            with SerialCart(settings(peer.port)) as cart:
                assert cart.set_motor(0) == 0
                peer.answer = lambda frame: ()
                cart.set_motor(50)  # is lost
                peer.tick(cart_counts=5, last_sequence=0)
                assert cart.get_state().cart_counts == 5
                peer.answer = lambda frame: CartPeer.answer(peer, frame)

    @pytest.mark.parametrize("passed_us", [0, -20_000, -1])
    def test_a_clock_that_does_not_advance_with_the_tick_is_refused(self, passed_us: int) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.tick()
            before = cart.get_state()
            peer.tick(time_us=before.time_us + passed_us)
            with pytest.raises(LinkError, match=rf"does not advance: STATE {before.tick} is of"):
                cart.get_state()

    def test_states_lost_before_the_first_info_are_no_matter(self) -> None:
        """A cart that is switched on sends states before anybody asks what it is."""
        with CartPeer(paced=True) as peer:
            answer = CartPeer.answer

            def state_first(frame: Frame) -> Iterable[bytes]:
                yield peer.next_state()
                peer.next_state()  # is lost
                yield peer.next_state()
                yield from answer(peer, frame)

            peer.answer = state_first
            with SerialCart(settings(peer.port)) as cart:
                assert cart.information.motor_limit == 255

    def test_a_clock_that_may_have_wrapped_unseen_is_believed(self) -> None:
        """A person may take an hour to answer a question; nobody reads states meanwhile."""
        for minutes in (1, 30, 40, 60, 71, 75, 140):
            with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
                peer.tick()
                before = cart.get_state()
                ticks = minutes * 60 * 50
                time_us = (before.time_us + ticks * 20_000) % 2**32
                peer.tick(tick=before.tick + ticks, time_us=time_us, cart_counts=7)
                assert cart.get_state().cart_counts == 7

    def test_a_command_that_comes_too_late_is_0(self) -> None:
        """The cart's watchdog has stopped the motor long ago; newer states wait to be read."""
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port, timeout=2.0)) as cart:
            peer.tick()
            cart.get_state()
            peer.tick()
            wait_for(lambda: cart._link.waiting() > 0)
            cart._newest_at -= 0.07
            assert cart.set_motor(200) == 0
            cart.get_state()
            assert cart.set_motor(200) == 200
            peer.tick(last_sequence=peer.state.last_sequence)
            cart.get_state()
            peer.tick()
            wait_for(lambda: cart._link.waiting() > 0)
            cart._newest_at -= 3.0
            with pytest.raises(LinkError, match=r"did not answer the cart on .* for 3\.\d s"):
                cart.set_motor(200)
            assert cart.set_motor(0) == 0
        assert [message.motor for message in peer.messages(SetMotor)] == [0, 0, 200, 0, 0]

    def test_time_that_passes_for_the_host_alone_makes_no_command_late(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            cart.get_state()
            cart._newest_at -= 100.0
            assert cart.set_motor(200) == 200

    def test_a_state_overtaken_while_opening_is_not_counted_back(self) -> None:
        with CartPeer() as peer:
            answer = CartPeer.answer
            late: list[bytes] = []

            def lose_one(frame: Frame) -> Iterable[bytes]:
                if not late:
                    late.append(peer.next_state())
                yield from answer(peer, frame)

            peer.answer = lose_one
            with SerialCart(settings(peer.port)) as cart:
                cart.statistics.lost_frames = 5
                peer.send(late[0])
                cart.poll_state()
                assert cart.statistics.lost_frames == 5

    def test_statistics_of_all_connections_are_kept(self) -> None:
        """A reconnection adds to them, but neither a boot banner nor what was said before it does."""
        with CartPeer(boot=b"ets Jul 29 2019\r\n\x00", paced=True) as peer:
            with SerialCart(settings(peer.port)) as cart:
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

    def test_gaps_in_the_tick_are_lost_frames(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.tick(tick=2**32 - 2)
            cart.get_state()
            peer.tick(tick=3)
            cart.get_state()
            assert cart.statistics.lost_frames == 4  # the last before the wrap, 0, 1 and 2

    def test_a_state_that_was_overtaken_is_neither_taken_nor_lost(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.tick(cart_counts=1)
            assert cart.get_state().cart_counts == 1
            overtaken, newer = peer.next_state(cart_counts=2), peer.next_state(cart_counts=3)
            peer.send(newer)
            assert cart.get_state().cart_counts == 3
            assert cart.statistics.lost_frames == 1
            peer.send(overtaken)
            peer.tick(cart_counts=4)
            assert cart.get_state().cart_counts == 4
            seen = cart.statistics
            assert (seen.overtaken_frames, seen.repeated_frames, seen.lost_frames) == (1, 0, 0)

    def test_a_state_that_comes_twice_is_taken_once(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.tick(tick=2**32 - 1, cart_counts=6)
            assert cart.get_state().cart_counts == 6
            tick = peer.next_state(tick=0, cart_counts=7)  # across the wrap
            peer.send(tick + tick)
            assert cart.get_state().cart_counts == 7
            wait_for(lambda: cart._link.waiting() == 0)
            peer.send(tick)
            peer.tick(cart_counts=8)
            assert cart.get_state().cart_counts == 8
            seen = cart.statistics
            assert (seen.overtaken_frames, seen.repeated_frames, seen.lost_frames) == (0, 2, 0)

    def test_a_tick_that_goes_far_back_is_a_restart_and_is_taken(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.tick(tick=500, cart_counts=5)
            assert cart.get_state().cart_counts == 5
            peer.tick(tick=1, time_us=20_000, cart_counts=0)
            assert cart.get_state().cart_counts == 0
            seen = cart.statistics
            assert (seen.overtaken_frames, seen.repeated_frames, seen.lost_frames) == (0, 0, 0)

    def test_silence_is_broken_by_a_hello(self) -> None:
        with Forgetful(SetMotor, 0) as peer, SerialCart(settings(peer.port)) as cart:
            cart.get_state()
            peer.deaf_to = 1
            hellos = len(peer.messages(Hello))
            cart.set_motor(50)
            cart.get_state()
            assert len(peer.messages(Hello)) == hellos + 1

    def test_lasting_silence_is_a_lost_link(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            cart.get_state()
            peer.answer = lambda frame: ()
            with pytest.raises(LinkError, match=r"no state came from .* for 0\.4 s"):
                cart.get_state()

    def test_a_pulled_cable_is_a_lost_link(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            cart.get_state()
            peer.unplug()
            with pytest.raises(LinkError, match="unplugged"):
                cart.poll_state()

    def test_latencies_are_summed_up_without_growing(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            for _ in range(30):
                cart.set_motor(0)
                cart.get_state()
            summary = cart.statistics.summary()
            assert summary.latency_samples == 29  # nothing had been read before the first command
            times = [
                summary.latency_median_ms,
                summary.latency_p99_ms,
                summary.latency_p999_ms,
                summary.latency_max_ms,
            ]
            assert times[0] > 0
            assert times == sorted(times)
            assert (summary.bad_frames, summary.lost_frames, summary.late_ticks) == (0, 0, 0)

    def test_the_loop_is_timed_by_the_carts_clock(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(settings(peer.port)) as cart:
            peer.tick()
            cart.get_state()
            for age in (13, 20):
                peer.answer = lambda frame, age=age: [
                    peer.next_state(last_sequence=frame.sequence, command_age_ms=age)
                ]
                cart.set_motor(50)
                cart.get_state()
            peer.answer = lambda frame: [peer.next_state(last_sequence=frame.sequence - 1)]
            cart.set_motor(50)  # is lost
            cart.get_state()
            assert sorted(cart.statistics.loop_times.samples()) == pytest.approx([0, 0.0065])


class TestAnswers:
    def test_a_question_that_was_lost_is_repeated(self) -> None:
        with Forgetful(Start, 1) as peer, SerialCart(settings(peer.port)) as cart:
            cart.start()
            assert len(peer.messages(Start)) == 2

    def test_a_question_that_is_never_answered(self) -> None:
        with Forgetful(Start, 99) as peer, SerialCart(settings(peer.port)) as cart:
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
    def test_a_refusal_says_why(self, reason: int, words: str) -> None:
        with Refusing(Start, reason) as peer, SerialCart(settings(peer.port)) as cart:
            with pytest.raises(RefusedError, match=words) as caught:
                cart.start()
            assert caught.value.reason == reason
            began = len(peer.received)
            assert cart.get_state()  # a refused frame is never acknowledged, and not waited for
            assert len(peer.received) == began

    def test_a_refusal_for_a_fault_is_a_fault(self) -> None:
        with Refusing(Start, Reason.FAULT_LATCHED) as peer, SerialCart(settings(peer.port)) as cart:
            with pytest.raises(FaultError, match="a fault is latched: remove its cause"):
                cart.start()
            assert not peer.flags & Flags.ARMED

    def test_a_refused_motor_value_is_raised_where_the_state_is_read(self) -> None:
        with Refusing(SetMotor, Reason.NOT_ARMED) as peer, SerialCart(settings(peer.port)) as cart:
            cart.set_motor(10)
            with pytest.raises(RefusedError, match=re.escape("not armed; has it restarted?")):
                cart.get_state()
            assert cart.get_state()

    def test_a_refusal_of_what_was_sent_before_the_last_question_is_void(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            cart.start()
            cart.set_motor(50)
            cart.get_state()
            cart.stop()
            before = next(frame for frame in reversed(peer.received) if isinstance(frame.message, SetMotor))
            peer.send(peer.encode(Nack(before.sequence, SetMotor.TYPE, Reason.NOT_ARMED)))
            assert cart.poll_state()  # the frames of the STOP changed places on their way

    def test_a_state_with_a_fault_is_returned_rather_than_raised(self) -> None:
        with Refusing(SetMotor, Reason.FAULT_LATCHED) as peer, SerialCart(settings(peer.port)) as cart:
            peer.state = replace(peer.state, fault=int(Fault.STALL))
            cart.set_motor(10)
            assert cart.get_state().fault == Fault.STALL

    def test_a_fault_that_stays_is_named_with_its_remedy(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            cart.clear_fault()
            peer.state = replace(peer.state, fault=int(Fault.POLE_ENCODER | Fault.STALL) | 0x8000)
            with pytest.raises(FaultError, match=r"motor's cable.*pole's encoder.*check its cable.*0x8000"):
                cart.clear_fault()

    def test_a_homing_that_fails_names_the_fault(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            peer.state = replace(peer.state, fault=int(Fault.HOMING))
            with pytest.raises(FaultError, match="homing failed"):
                cart.home()

    def test_a_homing_that_does_not_end(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port, nudge_after=0.01)) as cart:
            peer._carry_out = lambda message: setattr(peer, "flags", Flags.HOMING)
            with pytest.raises(PlantError, match=r"not done after 0\.1 s"):
                cart.home(timeout=0.1)
            assert isinstance(peer.received[-1].message, Stop)

    def test_the_period_is_set_and_known(self) -> None:
        with CartPeer() as peer, SerialCart(settings(peer.port)) as cart:
            assert cart.set_period(10_000).period_us == 10_000
            assert cart.information.period_us == 10_000


PROGRAM = """
import sys, time
from cartpole_rl.plants.serial.cart import SerialCart, SerialSettings
with SerialCart(SerialSettings(port=sys.argv[1])) as cart:
    cart.start()
    cart.set_motor(200)
    print("driving", flush=True)
    while True:
        cart.get_state()
        cart.set_motor(200)
        time.sleep(0.01)
"""


def test_ctrl_c_stops_the_motor_of_a_running_program() -> None:
    with CartPeer() as peer:
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, peer.port], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        assert program.stdout.readline() == b"driving\n"
        program.send_signal(signal.SIGINT)
        _, errors = program.communicate(timeout=20)
        assert b"KeyboardInterrupt" in errors
        assert [type(frame.message) for frame in peer.received[-2:]] == [SetMotor, Stop]
        assert peer.state.motor_applied == 0


def drive_and_fail(
    cart: SerialCart, error: type[BaseException], first: Callable[[], None] = lambda: None
) -> None:
    cart.start()
    cart.set_motor(200)
    cart.get_state()
    first()
    raise error


def wait_for(condition: Callable[[], bool], seconds: float = 5.0) -> None:
    event = threading.Event()
    for _ in range(int(seconds / 0.005)):
        if condition():
            return
        event.wait(0.005)
    raise AssertionError("waited in vain")
