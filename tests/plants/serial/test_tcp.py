"""A cart behind a TCP port of this computer is driven, watched and lost like one behind a pseudo-terminal."""

import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
from serial_peer import wait_for

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from cartpole_rl.emulator.link import PtyLink, TcpLink, open_link
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import EmulatorError, LinkError, PortError
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.port import open_port
from cartpole_rl.wire.messages import State


def truth(**settings: object) -> EmulatorSettings:
    return EmulatorSettings.model_validate({"port": "tcp", "physics_step": 1e-3} | settings)


@contextmanager
def connected(**settings: object) -> Iterator[SerialCart]:
    with EmulatedCart(truth(**settings)) as emulated, SerialCart(emulated.settings) as cart:
        yield cart


def test_the_next_host_is_served_when_one_has_closed_the_port() -> None:
    with TcpLink() as line:
        assert line.port.startswith("socket://127.0.0.1:")
        with open_port(line.port, 921600, 1.0):
            line.read(5)
        assert line.read(5) == b""  # closed
        line.write(b"nobody reads this")
        with open_port(line.port, 921600, 1.0) as host:
            assert line.read(5) == b""
            line.write(b"the next host")
            wait_for(lambda: host.in_waiting == 13, 20)


def test_a_port_that_is_closed_is_an_error_and_so_is_one_that_nobody_listens_to() -> None:
    with TcpLink() as line:
        host = open_port(line.port, 921600, 1.0)
        line.read(5)
    with pytest.raises(OSError, match="disconnected"):
        host.read(1)
    with pytest.raises(PortError, match="refused"):
        open_port(line.port, 921600, 1.0)


def test_it_listens_to_this_computer_alone() -> None:
    with TcpLink() as line:
        number = int(line.port.rpartition(":")[2])
        with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.2", number), 5):
            pass


def states(port: str) -> list[State]:
    """The states of a cart in lockstep; sequences and ticks begin anywhere."""
    with connected(port=port) as cart:
        found = [cart.poll_state() for _ in range(60)]
    first = found[0]
    return [
        replace(each, last_sequence=0, tick=each.tick - first.tick, time_us=each.time_us - first.time_us)
        for each in found
    ]


def test_lockstep_is_the_same_as_over_a_pseudo_terminal() -> None:
    assert states("tcp") == states("pty")


def test_the_firmware_runs_on_without_a_host() -> None:
    """So its watchdog stops a cart whose host was killed."""
    with EmulatedCart(truth(clock="real")) as emulated:
        with SerialCart(emulated.settings) as cart:
            after = before = cart.get_state()
        deadline = time.monotonic() + 60
        while after.tick - before.tick < 15 and time.monotonic() < deadline:
            time.sleep(0.3)
            with SerialCart(emulated.settings) as cart:
                after = cart.get_state()
    assert after.tick - before.tick >= 15
    # periods of 20 ms, some longer on a busy machine
    assert after.time_us - before.time_us >= 20_000 * (after.tick - before.tick)


def test_a_pulled_cable_is_a_lost_link() -> None:
    with pytest.raises(LinkError, match="unplugged"), connected(unplug_at=0.5) as cart:
        drain(cart)


def drain(cart: SerialCart) -> None:
    while True:
        cart.poll_state()


def test_a_system_without_pseudo_terminals_gets_a_tcp_port(monkeypatch: pytest.MonkeyPatch) -> None:
    with open_link("auto") as line:
        assert isinstance(line, PtyLink)
    monkeypatch.setitem(sys.modules, "termios", None)
    with open_link("auto") as line:
        assert isinstance(line, TcpLink)
    with pytest.raises(EmulatorError, match="use tcp"):
        open_link("pty")
