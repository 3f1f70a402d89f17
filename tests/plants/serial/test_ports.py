"""Which port is the cart: pure functions of a list of ports as pyserial gives it."""

import fcntl
import os
import re
import struct
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from serial import Serial
from serial.tools.list_ports_common import ListPortInfo
from serial_peer import CartPeer, Peer, quick_settings

from cartpole_rl.errors import LinkError, PortError
from cartpole_rl.plants.serial import cart as cart_module
from cartpole_rl.plants.serial import port
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.port import (
    UsbPort,
    cart_like,
    changes,
    described,
    found_ports,
    only_cart,
    open_port,
    port_of,
    usb_ports,
)
from cartpole_rl.plants.settings import SerialSettings


def listed(device: str, vid: int | None, product: str | None = None) -> ListPortInfo:
    port = ListPortInfo(device)
    port.vid, port.pid, port.product = vid, 0x7523 if vid else None, product
    port.location = "1-1.2" if vid else None
    return port


CH340 = UsbPort("/dev/ttyUSB0", 0x1A86, 0x7523, "USB Serial")
FTDI = UsbPort("/dev/ttyUSB1", 0x0403, 0x6001, "FT232R", "A50285BI")
MODEM = UsbPort("/dev/ttyACM0", 0x2C7C, 0x0125)


def test_a_computers_own_lines_are_left_out() -> None:
    ports = [
        listed("/dev/ttyUSB1", 0x0403, "FT232R"),
        listed("/dev/ttyS0", None),
        listed("/dev/ttyACM0", 0x303A),
    ]
    assert usb_ports(ports) == [
        UsbPort("/dev/ttyACM0", 0x303A, 0x7523, location="1-1.2"),
        UsbPort("/dev/ttyUSB1", 0x0403, 0x7523, "FT232R", location="1-1.2"),
    ]


@pytest.mark.parametrize(
    ("vendor", "words"),
    [
        (0x10C4, "CP210x"),
        (0x1A86, "CH340"),
        (0x0403, "FTDI"),
        (0x303A, "Espressif"),
        (0x0483, "ST-LINK"),
        (0x2C7C, "no chip"),
    ],
)
def test_a_board_is_told_by_its_chip(vendor: int, words: str) -> None:
    port = UsbPort("/dev/ttyUSB0", vendor, 1)
    assert words in described(port)
    assert cart_like([port]) == ([] if words == "no chip" else [port])


def test_a_description_has_what_tells_two_of_a_kind_apart() -> None:
    assert described(FTDI) == "FTDI 'FT232R', id 0403:6001, serial number A50285BI"


def test_what_came_and_went() -> None:
    assert changes([CH340, FTDI], [FTDI]) == ([CH340], [])
    assert changes([FTDI], [CH340, FTDI]) == ([], [CH340])
    assert changes([FTDI], [FTDI]) == ([], [])


GONE = r"the cart's port \(FTDI .*A50285BI\) is gone; there are .*: plug the"
MOVED = r"is at /dev/ttyUSB0 now: give plant.port=/dev/ttyUSB0"


@pytest.mark.parametrize(
    ("earlier", "given", "now", "found"),
    [
        (FTDI, "auto", [CH340, FTDI], "/dev/ttyUSB1"),
        (FTDI, "auto", [replace(FTDI, device="/dev/ttyUSB0")], "/dev/ttyUSB0"),
        (FTDI, "/dev/ttyUSB1", [CH340, FTDI], "/dev/ttyUSB1"),
        (FTDI, "/dev/ttyUSB1", [replace(FTDI, device="/dev/ttyUSB0")], MOVED),
        (FTDI, "auto", [CH340], GONE),
        (FTDI, "auto", [replace(FTDI, serial_number="other")], GONE),
        (FTDI, "/dev/ttyUSB1", [replace(CH340, device="/dev/ttyUSB1")], GONE),
        (CH340, "auto", [replace(CH340, device=f"/dev/ttyUSB{number}") for number in (1, 2)], "is gone"),
    ],
)
def test_a_connection_that_was_lost_is_made_to_the_same_device(
    earlier: UsbPort, given: str, now: list[UsbPort], found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that moved is named, and of two alike none is taken."""
    monkeypatch.setattr(port, "found_ports", lambda: now)
    if found.startswith("/dev"):
        assert port_of(earlier, given) == found
        return
    with pytest.raises(PortError, match=found):
        port_of(earlier, given)


@pytest.mark.parametrize("number", ["", "0001"])
def test_a_board_without_its_own_serial_number_is_known_by_its_socket(
    number: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (first,) = usb_ports([listed("/dev/ttyUSB0", 0x1A86)])
    first = replace(first, serial_number=number, location="1-1.2")
    now = [replace(first, device="/dev/ttyUSB3")]
    monkeypatch.setattr(port, "found_ports", lambda: now)
    assert port_of(first, "auto") == "/dev/ttyUSB3"
    for device in ("/dev/ttyUSB0", "/dev/ttyUSB3"):
        now[:] = [replace(first, device=device, location="3-4")]
        for given in ("auto", first.device):
            with pytest.raises(PortError, match=r"is gone.*plug the same cart in again where it was"):
                port_of(first, given)


@pytest.mark.parametrize("given", ["auto", "a link"])
def test_another_cart_is_not_driven_after_the_first_was_unplugged(
    given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with CartPeer() as first, CartPeer() as second:
        link = tmp_path / "cart"
        link.symlink_to(first.port)
        plugged = [replace(FTDI, device=first.port)]
        for module in (port, cart_module):
            monkeypatch.setattr(module, "found_ports", lambda: plugged)
        cart = SerialCart(quick_settings(given if given == "auto" else str(link)))
        for _ in range(2):
            cart.open()
            cart.close()
        link.unlink()
        link.symlink_to(second.port)
        plugged[:] = [replace(FTDI, device=second.port, serial_number="other")]
        with pytest.raises(PortError, match="plug the same cart in again"):
            cart.open()
        assert not second.received


def test_the_only_cart_is_taken_whatever_else_there_is() -> None:
    assert only_cart([MODEM, CH340]) == "/dev/ttyUSB0"


@pytest.mark.parametrize(
    ("ports", "words"),
    [
        ([CH340, FTDI, MODEM], r"2 of the ports .*ttyUSB0 \(WCH CH340.*ttyUSB1 \(FTDI.*watch=true"),
        ([], "looks like a cart; plug the cart in"),
        ([MODEM], r"looks like a cart; there are /dev/ttyACM0 \(no"),
    ],
)
def test_none_and_several_are_left_to_a_person(ports: list[UsbPort], words: str) -> None:
    with pytest.raises(PortError, match=words):
        only_cart(ports)


@pytest.mark.skipif(len(cart_like(found_ports())) == 1, reason="a cart is plugged in")
def test_a_cart_on_auto_says_why_it_finds_none() -> None:
    with pytest.raises(PortError, match=r"^plant\.port=auto: .*plant\.port="):
        SerialCart(SerialSettings(port="auto")).open()


@pytest.mark.parametrize(
    ("port", "words"),
    [
        ("rfc2217://localhost:1", "is not supported, as its writes have no time limit; let the bridge serve"),
        ("hwgrep://(", "is neither a device path nor a URL of pyserial: error('missing )"),
        ("socket://host", "names no TCP port; give socket://HOST:PORT"),
        ("ttyUSB77", "did you mean /dev/ttyUSB77?"),
        ("/dev/nosuch0", "/dev/nosuch0 does not exist: plug the cart in, or choose one of the ports found"),
        ("/tmp", "/tmp is not a serial port; cartpole-find-port lists them"),
        (__file__, f"{__file__} is not a serial port; cartpole-find-port lists them"),
        ("loop://?logging=foo", "is neither a device path nor a URL of pyserial: KeyError('foo')"),
    ],
)
def test_a_url_that_cannot_be_opened_is_named_in_one_line(port: str, words: str) -> None:
    with pytest.raises(PortError) as raised:
        open_port(port, 115200, 1.0)
    assert words in str(raised.value)
    assert str(raised.value).startswith(port)
    assert "\n" not in str(raised.value)


@pytest.mark.skipif(os.name == "nt", reason="pyserial's port of POSIX")
def test_a_device_that_vanishes_while_it_is_opened_may_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lost cart is looked for again after a PortError alone."""
    with Peer() as peer:
        last_step = Serial._reset_input_buffer

        def unplugged(line: Serial) -> None:
            peer.unplug()
            last_step(line)

        monkeypatch.setattr(Serial, "_reset_input_buffer", unplugged)
        with pytest.raises(PortError, match=f"^{peer.port} cannot be opened .*Input/output error$"):
            open_port(peer.port, 921600, 1.0)


TIOCGEXCL = 0x80045440  # of Linux; Python's termios does not have it


def is_exclusive(peer: Peer) -> bool:
    return struct.unpack("i", fcntl.ioctl(peer._slave, TIOCGEXCL, bytes(4)))[0] == 1


@pytest.fixture
def _pseudo_terminals_are_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    """Treat them as the ports of real carts, which nothing holds open once their host is gone."""
    monkeypatch.setattr("cartpole_rl.plants.serial.port.PSEUDO_TERMINAL", re.compile("none"))


@pytest.mark.skipif(sys.platform != "linux", reason="Linux's call")
@pytest.mark.usefixtures("_pseudo_terminals_are_ports")
class TestExclusive:
    def test_a_port_is_exclusive_while_it_is_open(self, peer: CartPeer) -> None:
        cart = SerialCart(quick_settings(peer.port))
        for _ in range(2):
            assert not is_exclusive(peer)
            cart.open()
            assert is_exclusive(peer)
            cart.close()
        assert not is_exclusive(peer)

    def test_a_port_without_a_cart_is_given_back(self) -> None:
        with Peer() as peer:
            with pytest.raises(LinkError, match="no cart answers"):
                SerialCart(quick_settings(peer.port, connect_timeout=0.3)).open()
            assert not is_exclusive(peer)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may open every file")
    def test_a_program_that_asks_for_no_lock_cannot_open_it(self) -> None:
        with CartPeer() as peer, SerialCart(quick_settings(peer.port)):
            with pytest.raises(OSError, match="busy"):
                os.open(peer.port, os.O_RDWR | os.O_NOCTTY)
            with pytest.raises(PortError, match="is busy"):
                open_port(peer.port, 921600, 1.0)

    def test_a_pulled_cable_is_closed_quietly(self) -> None:
        with CartPeer() as peer, SerialCart(quick_settings(peer.port)):
            peer.unplug()


@pytest.mark.skipif(sys.platform != "linux", reason="Linux's call")
def test_the_port_of_an_emulated_cart_can_be_opened_after_its_host_was_killed() -> None:
    """The emulator keeps it open, so that an exclusive port would stay so."""
    with CartPeer() as peer, SerialCart(quick_settings(peer.port)):
        assert not is_exclusive(peer)
