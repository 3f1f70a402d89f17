"""A cart on a port: opening it, the limits of motor values, and the ways out, on a scripted cart."""

import os
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from serial_peer import CartPeer, Peer, open_descriptors, quick_settings, wait_for

from cartpole_rl.errors import LinkError, PortError
from cartpole_rl.plants.serial.cart import LAST_STOP, LONGEST_STOP, SerialCart
from cartpole_rl.plants.serial.link import WriteTimeoutError
from cartpole_rl.plants.serial.port import why_not_open
from cartpole_rl.plants.settings import LONGEST_WRITE, SerialSettings
from cartpole_rl.signals import UNWINDING
from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import Flags, Hello, SetMotor, Stop


class TestOpening:
    def test_information_is_known_and_the_cart_is_disarmed(self) -> None:
        with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
            assert cart.information == peer.info
            assert cart.info() == peer.info
            assert peer.messages(Stop)

    def test_a_boot_banner_and_noise_are_passed_over(self) -> None:
        boot = b"ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET)\x00\x07\x01\x00" + bytes(range(256)) * 3
        with CartPeer(boot) as peer, SerialCart(quick_settings(peer.port)) as cart:
            assert cart.get_state().pole_counts == 2048
            assert cart.statistics.bad_frames == 0

    def test_noise_between_frames_is_counted_and_passed_over(self) -> None:
        with CartPeer(paced=True) as peer, SerialCart(quick_settings(peer.port)) as cart:
            peer.send(b"\x05noise\x00" + b"y" * 500 + b"\x00")
            peer.tick(cart_counts=7)
            assert cart.get_state().cart_counts == 7
            assert cart.statistics.bad_frames == 2

    def test_a_busy_port(self) -> None:
        with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
            with pytest.raises(PortError, match=f"{peer.port} is busy"):
                SerialCart(quick_settings(peer.port)).open()
            assert cart.get_state()

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may open every file")
    def test_a_port_that_may_not_be_opened(self) -> None:
        with CartPeer() as peer:
            Path(peer.port).chmod(0)
            with pytest.raises(PortError, match="dialout"):
                SerialCart(quick_settings(peer.port)).open()

    def test_the_word_for_missing_permission(self) -> None:
        assert "dialout" in why_not_open("/dev/ttyUSB0", PermissionError(13, "Permission denied"))

    def test_a_silent_device(self) -> None:
        with Peer() as peer:
            began = open_descriptors()
            with pytest.raises(LinkError, match="nothing came"):
                SerialCart(quick_settings(peer.port, connect_timeout=0.5)).open()
            assert open_descriptors() == began
            assert peer.messages(Stop)
            assert not peer.messages(Hello)  # it might wake a policy, as no STOP was answered

    def test_a_device_that_speaks_something_else(self) -> None:
        class Chatter(Peer):
            def answer(self, frame: Frame) -> Iterable[bytes]:
                return (b"ok T:20.4\x00",)

        with (
            Chatter() as peer,
            pytest.raises(LinkError, match=r"bytes came, the last bad frame: .*right baud"),
        ):
            SerialCart(quick_settings(peer.port, connect_timeout=0.5)).open()

    def test_methods_need_an_open_port(self) -> None:
        with pytest.raises(LinkError, match="is not open"):
            SerialCart(quick_settings("/dev/ttyUSB0")).get_state()


class TestMotor:
    @pytest.mark.parametrize(
        ("asked", "sent"), [(100, 100), (0, 0), (256, 255), (-9999, -255), (40_000, 255), (-(2**40), -255)]
    )
    def test_what_is_sent_is_within_the_limit_and_returned(self, asked: int, sent: int) -> None:
        with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
            assert cart.set_motor(asked) == sent
            while not cart.took_motor(state := cart.get_state()):
                pass  # a busy computer delays the peer
            assert state.motor_applied == sent
            assert peer.messages(SetMotor)[-1].motor == sent

    def test_the_cart_itself_sets_the_limit(self) -> None:
        with CartPeer() as peer:
            peer.info = replace(peer.info, motor_limit=180)
            with SerialCart(quick_settings(peer.port)) as cart:
                assert cart.set_motor(255) == 180

    @pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
    def test_every_way_out_stops_the_motor(self, error: type[BaseException]) -> None:
        with CartPeer() as peer:
            with pytest.raises(error), SerialCart(quick_settings(peer.port)) as cart:
                drive_and_fail(cart, error)
            assert [type(frame.message) for frame in peer.received[-2:]] == [SetMotor, Stop]
            assert peer.state.motor_applied == 0
            assert not peer.flags & Flags.ARMED

    def test_the_first_error_is_the_one_that_is_seen_on_a_dead_link(self) -> None:
        with (
            CartPeer() as peer,
            pytest.raises(ZeroDivisionError),
            SerialCart(quick_settings(peer.port)) as cart,
        ):
            drive_and_fail(cart, ZeroDivisionError, peer.unplug)


class Stalling(CartPeer):
    """Reads nothing from the port until `wait`, called in its own thread, returns."""

    def stall(self, cart: SerialCart, wait: Callable[[], None]) -> None:
        stalled, carry_on = threading.Event(), self.answer

        def answer(frame: Frame) -> Iterable[bytes]:
            self.answer = carry_on
            stalled.set()
            wait()
            return carry_on(frame)

        self.answer = answer
        cart.set_motor(0)
        assert stalled.wait(10)
        port = os.open(self.port, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
        for _ in range(20):  # the system moves bytes on for a moment
            with suppress(BlockingIOError):
                while True:
                    os.write(port, bytes(1))
            time.sleep(0.01)
        os.close(port)


@pytest.mark.parametrize("ticks", [0, 15])
def test_a_motor_value_that_the_port_takes_late_is_refused_if_the_cart_ticked_on(ticks: int) -> None:
    """A lockstep emulator does not: it waits for the host, which may have been suspended in a write."""
    patient = {"write_timeout": 10.0, "timeout": 10.0, "nudge_after": 10.0, "answer_timeout": 10.0}
    with Stalling() as peer, SerialCart(quick_settings(peer.port, **patient)) as cart:
        cart.start()
        cart.get_state()
        cart.set_motor(100)
        cart.get_state()
        writes = threading.Event()

        def wait() -> None:
            writes.wait(10)
            time.sleep(0.3)  # 15 periods
            for _ in range(ticks):
                peer.tick()

        peer.stall(cart, wait)
        writes.set()
        assert cart.set_motor(200) == 200
        if not ticks:
            wait_for(lambda: peer.state.motor_applied == 200)
            return
        with pytest.raises(LinkError, match="it answered a state over three periods old"):
            read_on(cart)
        assert peer.state.motor_applied == 0


def read_on(cart: SerialCart) -> None:
    """Read states until one raises: on a busy machine a refusal comes after the first."""
    while True:
        cart.get_state()


def test_the_end_waits_a_few_seconds_at_most_whatever_the_settings(caplog: pytest.LogCaptureFixture) -> None:
    with CartPeer() as peer:
        cart = SerialCart(SerialSettings(port=peer.port, answer_timeout=60, retries=100))
        cart.open()
        peer.answer = lambda frame: ()
        before = len(peer.messages(Stop))
        started = time.monotonic()
        with pytest.raises(LinkError, match="did not answer STOP, asked 2 times"):
            cart.stop()
        cart.close()
        assert time.monotonic() - started < 30
        assert "its motor may still be on" in caplog.text
        assert len(peer.messages(Stop)) - before >= 2 + 2  # for LONGEST_STOP, then for LAST_STOP


@pytest.mark.parametrize("settings", [{"retries": 0}, {"retries": 1, "answer_timeout": 0.01}])
def test_stop_is_repeated_through_noise_whatever_the_settings(settings: dict[str, float]) -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port, **settings)) as cart:
        first = len(peer.messages(Stop))

        def deaf(frame: Frame) -> Iterable[bytes]:
            return () if len(peer.messages(Stop)) <= first + 3 else CartPeer.answer(peer, frame)

        peer.answer = deaf
        cart.stop()
        assert len(peer.messages(Stop)) >= first + 4


def test_stop_is_repeated_where_the_port_takes_no_bytes_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)) as cart:
        cart.start()
        before, write, full = len(peer.messages(Stop)), cart._connection.link.write, [True] * 3

        def fills(data: bytes) -> None:
            if full and full.pop():
                raise WriteTimeoutError("it takes no bytes")
            write(data)

        monkeypatch.setattr(cart._connection.link, "write", fills)
        cart.stop()
        assert not full
        assert len(peer.messages(Stop)) == before + 1
        assert not peer.flags & Flags.ARMED
        full.extend([True] * 3)
        with pytest.raises(WriteTimeoutError):
            cart.info()
        full[:] = [True] * 3  # as a board does that boots
        assert cart._connection.shake_hands() == cart.information
        assert not full


def test_an_interrupted_end_sends_stop_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    with CartPeer() as peer:
        cart = SerialCart(quick_settings(peer.port))
        cart.open()
        cart.start()
        before, request = len(peer.messages(Stop)), cart._connection.request

        def interrupted(*words: object, **more: object) -> object:
            monkeypatch.setattr(cart._connection, "request", request)
            raise KeyboardInterrupt

        monkeypatch.setattr(cart._connection, "request", interrupted)
        with pytest.raises(KeyboardInterrupt):
            cart.close()
        assert not cart.is_open
        wait_for(lambda: len(peer.messages(Stop)) > before)
        assert not peer.flags & Flags.ARMED


def test_a_signal_leaves_enough_time_for_the_end() -> None:
    assert LONGEST_STOP + LAST_STOP + LONGEST_WRITE < UNWINDING


def drive_and_fail(
    cart: SerialCart, error: type[BaseException], first: Callable[[], None] = lambda: None
) -> None:
    cart.start()
    cart.set_motor(200)
    cart.get_state()
    first()
    raise error
