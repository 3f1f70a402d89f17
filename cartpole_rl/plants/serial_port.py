"""Opens a serial port for a cart, and says in words why one cannot be opened.

An ESP32 board restarts when DTR or RTS rise, so both are set low before the port is opened. The operating
system may still pulse them for a moment; `SerialCart` therefore says hello until the cart has booted.
Source: Espressif, "Boot Mode Selection", esptool documentation; pyserial 3.5.
"""

import errno

import serial
from serial.tools import list_ports

from cartpole_rl.errors import PortError

READ_SLICE = 0.01  # s that one read blocks at most; callers look at their own clocks in between


def open_port(port: str, baud: int, write_timeout: float) -> serial.SerialBase:
    """Open `port`, a device path or one of pyserial's URLs, for this process alone.

    Raises PortError: it does not exist, is busy, may not be opened, or is not a serial port.
    """
    try:
        line = serial.serial_for_url(
            port,
            do_not_open=True,
            baudrate=baud,
            timeout=READ_SLICE,
            write_timeout=write_timeout,
            exclusive=True,
        )
        line.dtr = False
        line.rts = False
        line.open()
    except (OSError, ValueError) as error:
        raise PortError(why_not_open(port, error)) from error
    return line


def why_not_open(port: str, error: OSError | ValueError) -> str:
    """One line: the port, what is wrong with it, and the remedy."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"{port} does not exist: plug the cart in, or choose one of the ports found: {ports_found()}"
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"{port} may not be opened by this user: join the group that owns it, on most systems "
            "with `sudo usermod -a -G dialout $USER`, and log in again"
        )
    if number in (errno.EBUSY, errno.EAGAIN):
        return f"{port} is busy: another program has it open; close that (`fuser {port}` names it)"
    return f"{port} cannot be opened as a serial port: {error}"


def ports_found() -> str:
    """Paths of the USB serial ports of this computer, or "none"."""
    return (
        ", ".join(sorted(found.device for found in list_ports.comports() if found.vid is not None)) or "none"
    )
