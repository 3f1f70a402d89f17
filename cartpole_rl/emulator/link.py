"""The emulated cart's end of the cable: a pseudo-terminal, and the frames that go through it."""

import os
import select
import struct
from types import TracebackType
from typing import Self

from cartpole_rl.emulator.disturbance import Disturbance
from cartpole_rl.emulator.firmware import BANNER
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import EmulatorError
from cartpole_rl.wire.frames import END, FrameSplitter

READ_BYTES = 4096
LONGEST_WAIT = 0.5  # s; a signal that arrives just before a wait begins is noticed only after it


class PtyLink:
    """A pseudo-terminal in raw mode; a host opens `port` as it would open a serial port, again and again.

    It is in packet mode (tty_ioctl(4)): each read begins with a byte that is 0 before data, and else tells
    what the host did. One who opens a serial port throws away what came before, which is how it is noticed.
    """

    def __init__(self) -> None:
        """Raises EmulatorError on systems without pseudo-terminals."""
        try:
            import fcntl
            import pty
            import termios
            import tty
        except ImportError:
            raise EmulatorError(
                "the emulated cart needs a pseudo-terminal, which Linux and macOS have"
            ) from None
        self._master, self._slave = pty.openpty()  # the slave stays open: else a closed port ends the master
        tty.setraw(self._slave)
        fcntl.ioctl(self._master, termios.TIOCPKT, struct.pack("i", 1))
        self._flushed = termios.TIOCPKT_FLUSHREAD
        self.opened = False  # a host has opened the port
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._unsent = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Unplug the cable."""
        os.close(self._master)
        os.close(self._slave)

    def read(self, timeout: float = LONGEST_WAIT) -> bytes:
        """What the host wrote, after waiting for it for at most `timeout` seconds; b"" for nothing."""
        while select.select([self._master], [], [], min(timeout, LONGEST_WAIT))[0]:
            packet = os.read(self._master, READ_BYTES)
            if packet[0] == 0:
                return packet[1:]
            self.opened = self.opened or bool(packet[0] & self._flushed)
            timeout = 0.0
        return b""

    def write(self, data: bytes) -> None:
        """Write all of it, and wait for as long as the host does not read."""
        self._unsent += data
        while not self._flush():
            select.select([], [self._master], [], LONGEST_WAIT)

    def offer(self, data: bytes) -> None:
        """Write it, or drop it where the host has not read what came before; never wait or cut a frame."""
        if self._flush():
            self._unsent = data
            self._flush()

    def _flush(self) -> bool:
        """Push out what is left of earlier frames; returns whether nothing is left."""
        while self._unsent:
            try:
                self._unsent = self._unsent[os.write(self._master, self._unsent) :]
            except BlockingIOError:
                return False
        return True


class Channel:
    """Frames over a pseudo-terminal, with the settings' disturbances in both directions."""

    def __init__(self, link: PtyLink, settings: EmulatorSettings) -> None:
        self._link = link
        self._splitter = FrameSplitter()
        self._send = link.write if settings.clock == "lockstep" else link.offer
        self._inward = Disturbance(settings, "inward")
        self._outward = Disturbance(settings, "outward")
        self._greeted = False

    def receive(self, timeout: float = LONGEST_WAIT) -> list[bytes | None]:
        """Frames from the host, without their 0x00, after waiting at most `timeout` s; None is a lost one.

        One that is held back for its successor counts as lost until that comes. The first host to open the
        port is sent the boot banner.
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
        """Send one frame that ends with its 0x00; returns whether it left at once and undamaged."""
        arriving = self._outward.carry(frame[:-1])
        for stuffed in arriving:
            self._send(stuffed + END)
        return frame[:-1] in arriving
