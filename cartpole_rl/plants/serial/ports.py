"""USB serial ports, and those of them that may be a cart: pure functions of pyserial's list of ports.

A board is recognized by the vendor id of the chip between its USB plug and its serial line.
Source of the ids: the USB ID Repository, linux-usb.org/usb.ids.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from serial.tools.list_ports_common import ListPortInfo

BOARDS = {  # vendor ids of chips on ESP32, Arduino and Nucleo boards
    0x10C4: "Silicon Labs CP210x",
    0x1A86: "WCH CH340",
    0x0403: "FTDI",
    0x303A: "Espressif native USB",
    0x0483: "STMicroelectronics ST-LINK",
}


@dataclass(frozen=True, order=True)
class UsbPort:
    """A serial port on USB. Texts are empty if the device has none."""

    device: str  # path or name to open
    vendor: int  # USB vendor id
    product: int  # USB product id
    name: str = ""  # what the device calls itself
    serial_number: str = ""


def usb_ports(ports: Iterable[ListPortInfo]) -> list[UsbPort]:
    """Return pyserial's ports that are on USB, sorted; a computer's own ports have no vendor id."""
    return sorted(
        UsbPort(port.device, port.vid, port.pid or 0, port.product or "", port.serial_number or "")
        for port in ports
        if port.vid is not None
    )


def cart_like(ports: Iterable[UsbPort]) -> list[UsbPort]:
    """Return the ports whose chip is used on carts."""
    return [port for port in ports if port.vendor in BOARDS]


def described(port: UsbPort) -> str:
    """Describe a port to a person: its chip, its own name, its ids and serial number."""
    chip = BOARDS.get(port.vendor, "no chip that carts have")
    own = f" {port.name!r}" if port.name else ""
    number = f", serial number {port.serial_number}" if port.serial_number else ""
    return f"{chip}{own}, id {port.vendor:04x}:{port.product:04x}{number}"


def changes(before: Sequence[UsbPort], after: Sequence[UsbPort]) -> tuple[list[UsbPort], list[UsbPort]]:
    """Return the ports that vanished and those that appeared, between two lists."""
    return sorted(set(before) - set(after)), sorted(set(after) - set(before))
