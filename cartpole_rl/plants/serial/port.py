"""The serial ports of this computer: find those that may be a cart, open one, explain why it fails.

A board is recognized by the vendor id of the chip between its USB plug and its serial line (the USB ID
Repository, linux-usb.org/usb.ids). An ESP32 board restarts when DTR or RTS rise, so both are set low before
the port is opened. The operating system may still pulse them for a moment; `SerialCart` therefore repeats
STOP until the cart has booted. Source: Espressif, "Boot Mode Selection", esptool documentation; pyserial 3.5.
"""

import errno
import os
import re
import socket
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo
from serial.urlhandler.protocol_socket import Serial as SocketPort

from cartpole_rl.errors import PortError

try:
    import termios

    TERMINAL_ERROR: type[Exception] = termios.error  # no OSError: the device vanished while it was opened
except ImportError:  # Windows
    TERMINAL_ERROR = OSError

READ_SLICE = 0.01  # s that one read blocks at most; callers look at their own clocks in between
AUTO = "auto"
PSEUDO_TERMINAL = re.compile(r"/dev/(pts/\d+|ttys\d{3})")
WRONG_URL = (LookupError, re.error, NotImplementedError)  # of pyserial, for parts of a URL
COUNTED = 1 << 16  # waiting bytes of a TCP port, at most
BOARDS = {  # vendor ids of chips on ESP32, Arduino and Nucleo boards
    0x10C4: "Silicon Labs CP210x",
    0x1A86: "WCH CH340",
    0x0403: "FTDI",
    0x303A: "Espressif native USB",
    0x0483: "STMicroelectronics ST-LINK",
}


NOT_ITS_OWN = "", "0", "0001"  # serial numbers of CH340 and of many CP210x


@dataclass(frozen=True, order=True)
class UsbPort:
    """A serial port on USB. Texts are empty if the device has none."""

    device: str  # path or name to open
    vendor: int  # USB vendor id
    product: int  # USB product id
    name: str = ""  # what the device calls itself
    serial_number: str = ""
    location: str = ""  # the USB socket

    @property
    def identity(self) -> tuple[int, int, str]:
        """The identity of this device: its serial number, or else the socket that it is plugged into."""
        own = self.serial_number if self.serial_number not in NOT_ITS_OWN else f"at {self.location}"
        return self.vendor, self.product, own


def open_port(port: str, baud: int, write_timeout: float) -> serial.SerialBase:
    """Open `port`, a device path or one of pyserial's URLs, for this process alone.

    Raises PortError if it does not exist, is busy, may not be opened, or is not a serial port.
    """
    if port.lower().startswith("rfc2217://"):  # pyserial has no write_timeout for it
        raise PortError(
            f"{port}: rfc2217:// is not supported, as its writes have no time limit; let the bridge serve "
            "the port as raw TCP, and give socket://HOST:PORT"
        )
    if port.lower().startswith("socket://") and not re.search(r":\d+(/|$)", port[len("socket://") :]):
        raise PortError(f"{port} names no TCP port; give socket://HOST:PORT")
    try:
        line = (
            TcpPort()
            if port.lower().startswith("socket://")
            else serial.serial_for_url(port, do_not_open=True)
        )
        line.port, line.baudrate = port, baud
        line.timeout, line.write_timeout, line.exclusive = READ_SLICE, write_timeout, True
        line.dtr = False
        line.rts = False
        line.open()
    except (OSError, ValueError, OverflowError) as error:
        raise PortError(why_not_open(port, error)) from error
    except WRONG_URL as error:
        raise PortError(f"{port} is neither a device path nor a URL of pyserial: {error!r}") from error
    except TERMINAL_ERROR as error:
        raise PortError(why_not_open(port, OSError(*error.args))) from error
    set_exclusive(line, True)
    return line


def set_exclusive(line: serial.SerialBase, exclusive: bool) -> None:
    """Let no other program open a serial port, whether it asks for a lock or not, until it is closed.

    A modem manager that probes a port writes to it and asks for no lock. The port of an emulated cart is left
    alone: it would stay exclusive when its host is killed, since the emulator keeps it open.
    """
    descriptor = getattr(line, "fd", None)
    if descriptor is None:
        return
    with suppress(ImportError, OSError):
        import fcntl

        if not PSEUDO_TERMINAL.fullmatch(os.ttyname(descriptor)):
            fcntl.ioctl(descriptor, termios.TIOCEXCL if exclusive else termios.TIOCNXCL)


def resolved_port(port: str) -> str:
    """Return `port`, or for "auto" the only port of this computer that may be a cart. Raises PortError."""
    return only_cart(found_ports()) if port == AUTO else port


def port_of(earlier: UsbPort, port: str) -> str:
    """Return where the device `earlier` is now that was at `port`. Raises PortError if another one is there.

    A device may get another path when it is plugged in again. One without a serial number of its own is known
    by its socket; where that is not known either, none of several is taken for it.
    """
    ports = found_ports()
    paths = [each.device for each in ports if each.identity == earlier.identity]
    if len(paths) == 1 and is_name_of(port, paths[0]):
        return port  # a link follows its cart
    if earlier.device in paths:
        return earlier.device
    if len(paths) == 1 and port == AUTO:
        return paths[0]
    if len(paths) == 1:
        raise PortError(f"the cart that was at {port} is at {paths[0]} now: give plant.port={paths[0]}")
    where = " where it was" if earlier.serial_number in NOT_ITS_OWN else ""
    raise PortError(
        f"the cart's port ({described(earlier)}) is gone; there are {named(ports) or 'none'}: plug the same "
        f"cart in again{where}, or start the command again for another one"
    )


def is_name_of(port: str, device: str) -> bool:
    """Return True if `port` names `device`: itself, a link, tty.* on macOS, another case on Windows."""
    if os.name == "nt":
        return port.lower() == device.lower()
    return os.path.realpath(port).replace("/dev/tty.", "/dev/cu.") == device


def only_cart(ports: Iterable[UsbPort]) -> str:
    """Return the path of the only port that may be a cart. Raises PortError, which names the ports found."""
    ports = list(ports)
    carts = cart_like(ports)
    if len(carts) == 1:
        return carts[0].device
    if carts:
        raise PortError(
            f"plant.port=auto: {len(carts)} of the ports may be the cart: {named(carts)}; choose one, as "
            f"plant.port={carts[0].device}; `cartpole-find-port watch=true` shows which one it is"
        )
    others = f"; there are {named(ports)}" if ports else ""
    raise PortError(
        f"plant.port=auto: no port looks like a cart{others}; plug the cart in, or give plant.port=..."
    )


def found_ports() -> list[UsbPort]:
    """Return the USB serial ports of this computer; none if one is unplugged while they are listed."""
    try:
        return usb_ports(list_ports.comports())
    except (TypeError, OSError):  # of pyserial, where the system's files of a device vanish
        return []


def why_not_open(port: str, error: OSError | ValueError | OverflowError) -> str:
    """Return one line: the port, what is wrong with it, and the remedy."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        meant = f" (did you mean /dev/{port}?)" if os.name == "posix" and "/" not in port else ""
        wrong = f"does not exist{meant}" if number == errno.ENOENT else "has no device behind it"
        return (
            f"{port} {wrong}: plug the cart in, or choose one of the ports found: "
            f"{named(found_ports()) or 'none'}"
        )
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"{port} may not be opened by this user: join the group that owns it, on most systems "
            "with `sudo usermod -a -G dialout $USER`, and log in again"
        )
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"{port} is busy: another program has it open; close that (`fuser {port}` names it)"
    numbers = number, *getattr(error.__context__, "args", ())  # pyserial drops it
    if number == errno.EISDIR or errno.ENOTTY in numbers:
        return f"{port} is not a serial port; cartpole-find-port lists them"
    return f"{port} cannot be opened as a serial port: {error}"


def named(ports: Iterable[UsbPort]) -> str:
    """Return the ports in one line: "/dev/ttyUSB0 (CH340), /dev/ttyUSB1 (FTDI)"."""
    return ", ".join(f"{port.device} ({described(port)})" for port in ports)


class TcpPort(SocketPort):
    """socket://HOST:PORT: an emulated cart, or a bridge such as ser2net.

    pyserial's own port of this kind counts at most one waiting byte and collects small frames.
    """

    def open(self) -> None:
        """Open the port; frames are sent at once. Raises SerialException."""
        super().open()
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @property
    def in_waiting(self) -> int:
        """The number of bytes that have arrived, up to COUNTED. Raises OSError."""
        try:
            return len(self._socket.recv(COUNTED, socket.MSG_PEEK))
        except BlockingIOError:
            return 0


def usb_ports(ports: Iterable[ListPortInfo]) -> list[UsbPort]:
    """Return pyserial's ports that are on USB, sorted; a computer's own ports have no vendor id."""
    return sorted(
        UsbPort(
            port.device,
            port.vid,
            port.pid or 0,
            port.product or "",
            port.serial_number or "",
            port.location or "",
        )
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
