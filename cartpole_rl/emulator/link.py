"""The emulated cart's end of the cable: a pseudo-terminal and its frames."""

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
LONGEST_WAIT = 0.5  # s; a signal that arrives just before a wait is handled after it


class PtyLink:
    """A pseudo-terminal in raw mode; a host can open `port` like a serial port, any number of times.

    It is in packet mode (tty_ioctl(4)): each read begins with a byte that is 0 before data and otherwise
    reports an action of the host. A host that opens a serial port flushes its input, and that is reported.
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
        """Wait at most `timeout` seconds; return what the host wrote, or b""."""
        while select.select([self._master], [], [], min(timeout, LONGEST_WAIT))[0]:
            packet = os.read(self._master, READ_BYTES)
            if packet[0] == 0:
                return packet[1:]
            self.opened = self.opened or bool(packet[0] & self._flushed)
            timeout = 0.0
        return b""

    def write(self, data: bytes) -> None:
        """Write all data; wait while the host does not read."""
        self._unsent += data
        while not self._flush():
            select.select([], [self._master], [], LONGEST_WAIT)

    def offer(self, data: bytes) -> None:
        """Write a frame, or drop it if the host has not read earlier frames; never wait or cut a frame."""
        if self._flush():
            self._unsent = data
            self._flush()

    def _flush(self) -> bool:
        """Write the rest of earlier frames; return whether nothing is left."""
        while self._unsent:
            try:
                self._unsent = self._unsent[os.write(self._master, self._unsent) :]
            except BlockingIOError:
                return False
        return True


class Channel:
    """Frames over a pseudo-terminal, disturbed in both directions as the settings say."""

    def __init__(self, link: PtyLink, settings: EmulatorSettings) -> None:
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
