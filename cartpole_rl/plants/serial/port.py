"""Find and open the serial port of a cart; explain why it cannot be found or opened.

An ESP32 board restarts when DTR or RTS rise, so both are set low before the port is opened. The operating
system may still pulse them for a moment; `SerialCart` therefore repeats STOP until the cart has booted.
Source: Espressif, "Boot Mode Selection", esptool documentation; pyserial 3.5.
"""

import errno
import os
import re
from collections.abc import Iterable
from contextlib import suppress

import serial
from serial.tools import list_ports

from cartpole_rl.errors import PortError
from cartpole_rl.plants.serial.ports import UsbPort, cart_like, described, usb_ports
from cartpole_rl.plants.serial.tcp import TcpPort

READ_SLICE = 0.01  # s that one read blocks at most; callers look at their own clocks in between
AUTO = "auto"
PSEUDO_TERMINAL = re.compile(r"/dev/(pts/\d+|ttys\d{3})")
WRONG_URL = (LookupError, re.error, NotImplementedError)  # of pyserial, for parts of a URL


def open_port(port: str, baud: int, write_timeout: float) -> serial.SerialBase:
    """Open `port`, a device path or one of pyserial's URLs, for this process alone.

    Raises PortError if it does not exist, is busy, may not be opened, or is not a serial port.
    """
    if port.lower().startswith("rfc2217://"):  # pyserial has no write_timeout for it
        raise PortError(
            f"{port}: rfc2217:// is not supported, as its writes have no time limit; let the bridge serve "
            "the port as raw TCP, and give socket://HOST:PORT"
        )
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
        import termios

        if not PSEUDO_TERMINAL.fullmatch(os.ttyname(descriptor)):
            fcntl.ioctl(descriptor, termios.TIOCEXCL if exclusive else termios.TIOCNXCL)


def resolved_port(port: str) -> str:
    """Return `port`, or for "auto" the only port of this computer that may be a cart. Raises PortError."""
    return only_cart(found_ports()) if port == AUTO else port


def only_cart(ports: Iterable[UsbPort]) -> str:
    """Return the path of the only port that may be a cart. Raises PortError, which names the ports found."""
    ports = list(ports)
    carts = cart_like(ports)
    if len(carts) == 1:
        return carts[0].device
    if carts:
        raise PortError(
            f"port=auto: {len(carts)} of the ports may be the cart: {named(carts)}; choose one, as "
            f"plant.port={carts[0].device}; `cartpole-find-port watch=true` shows which one it is"
        )
    others = f"; there are {named(ports)}" if ports else ""
    raise PortError(f"port=auto: no port looks like a cart{others}; plug the cart in, or give plant.port=...")


def found_ports() -> list[UsbPort]:
    """Return the USB serial ports of this computer."""
    return usb_ports(list_ports.comports())


def why_not_open(port: str, error: OSError | ValueError | OverflowError) -> str:
    """Return one line: the port, what is wrong with it, and the remedy."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return (
            f"{port} does not exist: plug the cart in, or choose one of the ports found: "
            f"{named(found_ports()) or 'none'}"
        )
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"{port} may not be opened by this user: join the group that owns it, on most systems "
            "with `sudo usermod -a -G dialout $USER`, and log in again"
        )
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"{port} is busy: another program has it open; close that (`fuser {port}` names it)"
    if errno.ENOTTY in (number, *getattr(error.__context__, "args", ())):  # pyserial drops the number
        return f"{port} is not a serial port; cartpole-find-port lists them"
    return f"{port} cannot be opened as a serial port: {error}"


def named(ports: Iterable[UsbPort]) -> str:
    """Return the ports in one line: "/dev/ttyUSB0 (CH340), /dev/ttyUSB1 (FTDI)"."""
    return ", ".join(f"{port.device} ({described(port)})" for port in ports)
