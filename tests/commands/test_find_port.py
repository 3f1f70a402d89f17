"""cartpole-find-port and its listings."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import in_process

from cartpole_rl.errors import PortError
from cartpole_rl.plants.serial.port import UsbPort, found_ports
from cartpole_rl.workflows.find_port import listing, watched

CH340 = UsbPort("/dev/ttyUSB0", 0x1A86, 0x7523)
FTDI = UsbPort("/dev/ttyUSB1", 0x0403, 0x6001)
MODEM = UsbPort("/dev/ttyACM0", 0x2C7C, 0x0125)


def test_the_command_lists_the_ports(tmp_path: Path) -> None:
    ports = found_ports()
    done = in_process("find_port", folder=tmp_path)
    if ports:
        assert done.code == 0
        assert all(port.device in done.out for port in ports)
    else:
        assert done.code == 1
        assert "no USB serial port was found: plug the cart in" in done.complaint
    assert not list(tmp_path.iterdir())


def test_a_watch_without_changes_times_out(tmp_path: Path) -> None:
    done = in_process("find_port", "watch=true", "timeout=0.3", folder=tmp_path)
    assert done.code == 1
    assert "Unplug the cart now" in done.out
    assert "no port appeared or vanished within 0.3 s" in done.complaint


@pytest.mark.parametrize(
    ("ports", "last"),
    [
        (
            [CH340, MODEM],
            "The cart is probably on it. Next: cartpole-preflight plant=serial plant.port=/dev/ttyUSB0",
        ),
        ([CH340, FTDI], "`cartpole-find-port watch=true` finds out which of them is the cart"),
        ([MODEM], "None of them has a chip used on carts (CP210x, CH340, FTDI, Espressif, ST-LINK)"),
    ],
)
def test_a_listing_ends_in_what_to_do(ports: list[UsbPort], last: str) -> None:
    *lines, end = listing(ports).splitlines()
    assert end == last
    assert [line.split()[0] for line in lines] == [port.device for port in ports]


def test_nothing_to_list() -> None:
    with pytest.raises(PortError, match="no USB serial port was found"):
        listing([])


@pytest.mark.parametrize(
    ("lists", "words"),
    [
        (([CH340, FTDI], [CH340, FTDI], [CH340]), "/dev/ttyUSB1 vanished: plant.port=/dev/ttyUSB1"),
        (([FTDI], [CH340, FTDI]), "/dev/ttyUSB0 appeared: plant.port=/dev/ttyUSB0"),
    ],
)
def test_the_port_that_changes_is_the_cart(lists: tuple[list[UsbPort], ...], words: str) -> None:
    following: Iterator[list[UsbPort]] = iter(lists)
    said = watched(lambda: next(following), timeout=10)
    assert said.startswith(words)
    port = words.split("plant.port=")[1]
    assert said.endswith(f" cartpole-preflight plant=serial plant.port={port}")
    assert ("Plug it in again" in said) == ("vanished" in words)
