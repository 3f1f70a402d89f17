"""Frames: COBS of (version u8, type u8, sequence u8, flags u8, payload, CRC-16 little-endian), then 0x00."""

from collections.abc import Iterator
from dataclasses import dataclass

from cartpole_rl.errors import FrameError
from cartpole_rl.wire import cobs
from cartpole_rl.wire.checksum import crc16
from cartpole_rl.wire.messages import MESSAGES, Message

VERSION = 1
END = b"\x00"
HEADER_BYTES = 4
CRC_BYTES = 2
LONGEST_FRAME = 64  # stuffed bytes without the end; the longest messages, INFO and STATE, take 30


@dataclass(frozen=True)
class Frame:
    """One message with the header it travelled in."""

    message: Message
    sequence: int
    flags: int = 0


@dataclass(frozen=True)
class Envelope:
    """A frame whose checksum is right, before its version, type and payload are judged."""

    version: int
    kind: int
    sequence: int
    flags: int
    payload: bytes


def encode_frame(message: Message, sequence: int, flags: int = 0) -> bytes:
    """Bytes for the wire, the ending 0x00 included. `sequence` is taken modulo 256."""
    body = bytes((VERSION, message.TYPE, sequence & 0xFF, flags)) + message.pack()
    return cobs.encode(body + crc16(body).to_bytes(CRC_BYTES, "little")) + END


def open_envelope(stuffed: bytes) -> Envelope:
    """The undamaged header and payload in `stuffed`, which comes without its ending 0x00.

    A device that refuses a frame with a reason starts here. Raises FrameError for bad stuffing, a frame
    cut short or a bad checksum.
    """
    data = cobs.decode(stuffed)
    if len(data) < HEADER_BYTES + CRC_BYTES:
        raise FrameError(f"a frame of {len(data)} bytes is cut short")
    body, checksum = data[:-CRC_BYTES], int.from_bytes(data[-CRC_BYTES:], "little")
    if crc16(body) != checksum:
        raise FrameError(f"checksum {checksum:#06x} is not {crc16(body):#06x}")
    version, kind, sequence, flags = body[:HEADER_BYTES]
    return Envelope(version, kind, sequence, flags, body[HEADER_BYTES:])


def decode_frame(stuffed: bytes) -> Frame:
    """The frame in `stuffed`, which comes without its ending 0x00.

    Raises FrameError for bad stuffing, a frame cut short, a bad checksum, a foreign version,
    an unknown type or a wrong payload length.
    """
    envelope = open_envelope(stuffed)
    if envelope.version != VERSION:
        raise FrameError(f"protocol version {envelope.version}; this side speaks {VERSION}")
    if envelope.kind not in MESSAGES:
        raise FrameError(f"unknown message type {envelope.kind:#04x}")
    return Frame(MESSAGES[envelope.kind].unpack(envelope.payload), envelope.sequence, envelope.flags)


class FrameSplitter:
    """Cuts a byte stream at each 0x00. Memory is bounded: an overlong run is dropped up to the next 0x00."""

    def __init__(self) -> None:
        self.pending = bytearray()  # of a frame whose 0x00 has not arrived
        self._dropping = False
        self.overlong = 0  # runs dropped so far

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield each whole stuffed frame, without its 0x00; empty ones are skipped."""
        for byte in data:
            if byte == 0:
                if self.pending and not self._dropping:
                    yield bytes(self.pending)
                self.pending.clear()
                self._dropping = False
            elif not self._dropping:
                self.pending.append(byte)
                if len(self.pending) > LONGEST_FRAME:
                    self.pending.clear()
                    self._dropping = True
                    self.overlong += 1
