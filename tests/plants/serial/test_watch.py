"""scripts/watch.py, started as its page says, prints what a scripted cart reports and moves nothing."""

import select
import signal
import subprocess
import sys
import termios
from collections.abc import Iterable
from pathlib import Path

from serial_peer import CartPeer, HomingForever, wait_for

from cartpole_rl.wire.frames import Frame
from cartpole_rl.wire.messages import ClearFault, Fault, Home, Nack, Reason, SetMotor, Start, Stop

SCRIPT = Path(__file__).parents[3] / "scripts/watch.py"
OUTPUT_SPEED = 5  # of termios.tcgetattr


def test_counts_are_printed_until_an_interrupt() -> None:
    with CartPeer(paced=True) as peer:
        command = [sys.executable, SCRIPT, peer.port, "--baud", "115200"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert "firmware_major=2" in process.stdout.readline()
            while not select.select([process.stdout], [], [], 0.01)[0]:
                peer.tick(cart_counts=123)
            assert "cart      123" in process.stdout.readline()
            assert termios.tcgetattr(peer.master)[OUTPUT_SPEED] == termios.B115200
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=60) == 0
        wait_for(lambda: isinstance(peer.received[-1].message, Stop))
        assert not peer.messages(Home) + peer.messages(Start)
        assert all(message == SetMotor(0) for message in peer.messages(SetMotor))


def test_a_hangup_while_the_cart_homes_stops_it() -> None:
    with HomingForever() as peer:
        command = [sys.executable, SCRIPT, peer.port, "--home"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            wait_for(lambda: bool(peer.messages(Home)))
            process.send_signal(signal.SIGHUP)
            assert process.wait(timeout=60) == 128 + signal.SIGHUP
        wait_for(lambda: isinstance(peer.received[-1].message, Stop))


def test_a_second_interrupt_does_not_leave_a_homing_cart_without_stop() -> None:
    with HomingForever() as peer:
        command = [sys.executable, SCRIPT, peer.port, "--home"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            wait_for(lambda: bool(peer.messages(Home)))
            before, peer.deaf_to = len(peer.messages(Stop)), 1
            process.send_signal(signal.SIGINT)
            wait_for(lambda: len(peer.messages(Stop)) > before)
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=60) == 0
        assert len(peer.messages(Stop)) >= before + 2  # the first was lost, the second is answered


class Faulted(CartPeer):
    """A cart that refuses HOME, since a fault is latched."""

    def answer(self, frame: Frame) -> Iterable[bytes]:
        if not isinstance(frame.message, Home):
            yield from super().answer(frame)
            return
        yield self.encode(Nack(frame.sequence, Home.TYPE, Reason.FAULT_LATCHED))
        yield self.next_state(last_sequence=frame.sequence, fault=Fault.HOMING)


def test_a_latched_fault_is_printed_with_what_clears_it() -> None:
    with Faulted() as peer:
        done = subprocess.run([sys.executable, SCRIPT, peer.port, "--home"], capture_output=True, text=True)
        assert not peer.messages(ClearFault)
    assert done.returncode == 1
    assert done.stderr.startswith("the cart refused HOME: a fault is latched")
    assert "a restart of the board clears the fault" in done.stderr
