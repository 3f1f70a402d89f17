"""Frames over an open serial port: bytes go out at once, come in as they arrive, and bad frames are dropped.

A receiver that starts in the middle of a frame, or receives noise, is synchronized again at the next 0x00.
"""

import os
import time
from contextlib import suppress
from typing import TYPE_CHECKING

import serial

from cartpole_rl.errors import FrameError, LinkError
from cartpole_rl.plants.serial.port import set_exclusive
from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.wire.frames import Frame, FrameSplitter, decode_frame, encode_frame
from cartpole_rl.wire.messages import Message

if TYPE_CHECKING:
    from cartpole_rl.plants.emulated import CartProcess

# Linux's has this name; macOS counts the time asleep in its CLOCK_MONOTONIC, and Windows in perf_counter
_CLOCK: int | None = getattr(time, "CLOCK_BOOTTIME", getattr(time, "CLOCK_MONOTONIC", None))


def now() -> float:
    """Return s since an arbitrary moment: the host's clock for everything that waits for a cart.

    It goes on while the computer sleeps. `time.perf_counter` stands still then on Linux and macOS: a state
    from before the sleep would look new, and the motor value that answers it would be sent.
    """
    return time.perf_counter() if _CLOCK is None else time.clock_gettime(_CLOCK)


class WriteTimeoutError(LinkError):
    """The operating system took no bytes within the write timeout, or a part of them: it may do so later."""


class SerialLink:
    """Both directions of one port, which a process `server` may serve. Times are those of `now`, in s."""

    def __init__(
        self, port: serial.SerialBase, statistics: LinkStatistics, server: "CartProcess | None" = None
    ) -> None:
        self._port, self._server = port, server
        self._splitter = FrameSplitter()
        self.statistics = statistics
        self.sequence = os.urandom(1)[0]  # of the newest frame sent; unlike that of the last host
        self.frames_sent = 0
        self.sent_at = self.received_at = now()
        self.bytes_received = 0
        self.why_bad = ""  # what was wrong with the newest bad frame

    @property
    def port(self) -> str:
        """Path or URL of the port, as a person knows it: of a bridge, that of its board."""
        return (self._server.board if self._server else "") or str(self._port.port)

    def send(self, *messages: Message) -> int:
        """Write the messages in one go and return the sequence of the last. Raises LinkError."""
        data = b""
        for message in messages:
            self.sequence = (self.sequence + 1) & 0xFF
            self.frames_sent += 1
            data += encode_frame(message, self.sequence)
        self.write(data)
        return self.sequence

    def write(self, data: bytes) -> None:
        """Write raw bytes within the port's write timeout. Raises WriteTimeoutError, LinkError."""
        try:
            taken = self._taken_at_once(data)
            if taken < len(data):
                self._port.write(data[taken:])
        except serial.SerialTimeoutException as error:
            raise WriteTimeoutError(f"{self.port} takes no bytes: {error}") from error
        except OSError as error:
            raise self._broken("written to", error) from error
        self.sent_at = now()

    def _taken_at_once(self, data: bytes) -> int:
        """Return how many bytes the system takes without a wait; 0 for a port without a descriptor.

        After its bytes were taken, pyserial 3.5 waits until the port would take more. That lasts until a
        kernel thread has delivered what arrives meanwhile: up to 5 ms on a busy machine.
        """
        descriptor = getattr(self._port, "fd", None)
        if descriptor is None:
            return 0
        try:
            return os.write(descriptor, data)
        except BlockingIOError:
            return 0

    def waiting(self) -> int:
        """Return the number of bytes that have arrived and are not read yet. Raises LinkError."""
        try:
            return self._port.in_waiting
        except OSError as error:
            raise self._broken("asked for bytes", error) from error

    def receive(self, waiting: int) -> list[Frame]:
        """Return the frames in the bytes that are `waiting`. Raises LinkError.

        If none are, wait one read slice for a first byte, and take what has arrived with it.
        """
        try:
            data = self._port.read(waiting or 1)
            if data and not waiting:
                data += self._port.read(self._port.in_waiting)
        except OSError as error:
            raise self._broken("read", error) from error
        if not data:
            return []
        self.received_at = now()
        self.bytes_received += len(data)
        overlong = self._splitter.overlong
        frames = [
            frame for stuffed in self._splitter.feed(data) if (frame := self._decode(stuffed)) is not None
        ]
        self.statistics.bad_frames += self._splitter.overlong - overlong
        self.statistics.frames_received += len(frames)
        return frames

    def close(self) -> None:
        """Give the port back; never raises."""
        with suppress(OSError):  # an unplugged port is as closed as it can be
            set_exclusive(self._port, False)
            self._port.close()

    def _decode(self, stuffed: bytes) -> Frame | None:
        try:
            return decode_frame(stuffed)
        except FrameError as error:
            self.why_bad = str(error)
            self.statistics.bad_frames += 1
            return None

    def _broken(self, what: str, error: OSError) -> LinkError:
        """Return an error with the reason of the server, if it has ended."""
        return LinkError(
            (self._server.death() if self._server else "")
            or f"{self.port} cannot be {what} any more: {error}; is the cart unplugged or without power?"
        )
