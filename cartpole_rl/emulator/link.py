"""The emulated cart's end of the cable, a pseudo-terminal or a TCP port, and its frames."""

import os
import random
import select
import socket
import struct
from abc import ABC, abstractmethod
from typing import Self

from cartpole_rl.emulator.firmware import BANNER
from cartpole_rl.emulator.settings import EmulatorSettings, Port
from cartpole_rl.errors import EmulatorError
from cartpole_rl.wire.frames import END, FrameSplitter

READ_BYTES = 4096
LONGEST_WAIT = 0.5  # s; a signal that arrives just before a wait is handled after it


class Link(ABC):
    """A port that one host at a time can open, any number of times."""

    port: str  # path or URL, for pyserial
    opened = False  # a host has opened the port

    def __init__(self) -> None:
        self._unsent = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Unplug the cable."""

    @abstractmethod
    def read(self, timeout: float = LONGEST_WAIT) -> bytes:
        """Wait at most `timeout` seconds; return what the host wrote, or b""."""

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """Write as many bytes as the host's buffer takes; return their number. Raises BlockingIOError."""

    @abstractmethod
    def _await_room(self) -> None:
        """Wait a while for room in the host's buffer."""

    def write(self, data: bytes) -> None:
        """Write all data; wait while the host does not read."""
        self._unsent += data
        while not self._flush():
            self._await_room()

    def offer(self, data: bytes) -> None:
        """Write a frame, or drop it if the host has not read earlier frames; never wait or cut a frame."""
        if self._flush():
            self._unsent = data
            self._flush()

    def _flush(self) -> bool:
        """Write the rest of earlier frames; return whether nothing is left."""
        while self._unsent:
            try:
                self._unsent = self._unsent[self._write(self._unsent) :]
            except BlockingIOError:
                return False
        return True


class PtyLink(Link):
    """A pseudo-terminal in raw mode; a host can open `port` like a serial port.

    It is in packet mode (tty_ioctl(4)): each read begins with a byte that is 0 before data and otherwise
    reports an action of the host. A host that opens a serial port flushes its input, and that is reported.
    """

    def __init__(self) -> None:
        """Raises ImportError on a system without pseudo-terminals."""
        import fcntl
        import pty
        import termios
        import tty

        super().__init__()
        self._master, self._slave = pty.openpty()  # the slave stays open: else a closed port ends the master
        tty.setraw(self._slave)
        fcntl.ioctl(self._master, termios.TIOCPKT, struct.pack("i", 1))
        self._flushed = termios.TIOCPKT_FLUSHREAD
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)

    def close(self) -> None:
        """Unplug the cable."""
        os.close(self._master)
        os.close(self._slave)

    def read(self, timeout: float = LONGEST_WAIT) -> bytes:
        """Wait at most `timeout` seconds; return what the host wrote, or b""."""
        while select.select([self._master], [], [], min(timeout, LONGEST_WAIT))[0]:
            packet = os.read(self._master, READ_BYTES)
            if packet[0] == 0:
                return packet[1:]
            self.opened = self.opened or bool(packet[0] & self._flushed)
            timeout = 0.0
        return b""

    def _write(self, data: bytes) -> int:
        return os.write(self._master, data)

    def _await_room(self) -> None:
        select.select([], [self._master], [], LONGEST_WAIT)


class TcpLink(Link):
    """A TCP port of this computer, which pyserial opens as socket://127.0.0.1:PORT.

    A second host waits until the first has closed the port. Bytes for a port that nobody has open are lost.
    """

    def __init__(self) -> None:
        super().__init__()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        self._host: socket.socket | None = None

    def close(self) -> None:
        """Unplug the cable."""
        self._hang_up()
        self._listener.close()

    def read(self, timeout: float = LONGEST_WAIT) -> bytes:
        """Wait at most `timeout` seconds for a host, or for bytes; return what the host wrote, or b""."""
        if not select.select([self._host or self._listener], [], [], min(timeout, LONGEST_WAIT))[0]:
            return b""
        if self._host is None:
            self._accept()
            return b""
        try:
            data = self._host.recv(READ_BYTES)
        except ConnectionError:
            data = b""
        if not data:  # the host closed the port
            self._hang_up()
        return data

    def _accept(self) -> None:
        self._host, _ = self._listener.accept()
        self._host.setblocking(False)
        self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.opened = True

    def _hang_up(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None

    def _write(self, data: bytes) -> int:
        if self._host is not None:
            try:
                return self._host.send(data)
            except ConnectionError:
                self._hang_up()
        return len(data)

    def _await_room(self) -> None:
        select.select([], [self._host] if self._host else [], [], LONGEST_WAIT)


def open_link(port: Port) -> Link:
    """Return a pseudo-terminal or a TCP port, as `port` says. Raises EmulatorError without the former."""
    if port == "tcp":
        return TcpLink()
    try:
        return PtyLink()
    except ImportError:
        if port == "pty":
            raise EmulatorError("emulator.port=pty: this system has no pseudo-terminals; use tcp") from None
        return TcpLink()


class Disturbance:
    """One direction of a bad cable, repeatable by seed: loss, corruption, duplication, reordering.

    The final 0x00 always arrives, so frames never merge or split.
    """

    def __init__(self, settings: EmulatorSettings, direction: str) -> None:
        """Take the shares of frames from the settings; the seed and `direction` decide which frames."""
        self._settings = settings
        self._damage_dice = random.Random(f"{direction} {settings.seed}")
        self._order_dice = random.Random(f"{direction} order {settings.seed}")
        self._held: list[bytes] = []  # one frame, or its two copies, that arrives after the next frame

    def carry(self, stuffed: bytes) -> list[bytes]:
        """Send a frame; return the frames that arrive now, in order, each without its final 0x00."""
        settings, dice = self._settings, self._damage_dice
        lost, damaged = dice.random() < settings.frame_loss, dice.random() < settings.frame_corruption
        twice = self._order_dice.random() < settings.frame_duplication
        late = self._order_dice.random() < settings.frame_reordering
        if lost:
            return []
        arriving = [self._damage(stuffed) if damaged else stuffed] * (1 + twice)
        if late and not self._held:
            self._held = arriving
            return []
        held, self._held = self._held, []
        return arriving + held

    def _damage(self, stuffed: bytes) -> bytes:
        dice = self._damage_dice
        at = dice.randrange(len(stuffed))
        wrong = dice.choice([byte for byte in range(1, 256) if byte != stuffed[at]])
        return stuffed[:at] + bytes([wrong]) + stuffed[at + 1 :]


class Channel:
    """Frames over a link, disturbed in both directions as the settings say."""

    def __init__(self, link: Link, settings: EmulatorSettings) -> None:
        self._link = link
        self._splitter = FrameSplitter()
        self._send = link.write if settings.clock == "lockstep" else link.offer
        self._inward = Disturbance(settings, "inward")
        self._outward = Disturbance(settings, "outward")
        self._greeted = False

    def receive(self, timeout: float = LONGEST_WAIT) -> list[bytes | None]:
        """Wait at most `timeout` s; return the host's frames without their 0x00, None for each lost one.

        A reordered frame counts as lost until its successor arrives. The first host that opens the port
        receives the boot banner.
        """
        data = self._link.read(timeout)
        if self._link.opened and not self._greeted:
            self._greeted = True
            self._send(BANNER)
        frames: list[bytes | None] = []
        for frame in self._splitter.feed(data):
            frames += self._inward.carry(frame) or [None]
        return frames

    def send(self, frame: bytes) -> bool:
        """Send one frame with its final 0x00; return whether it was sent at once and undamaged."""
        arriving = self._outward.carry(frame[:-1])
        for stuffed in arriving:
            self._send(stuffed + END)
        return frame[:-1] in arriving
