"""Frames: COBS of (version u8, type u8, sequence u8, flags u8, payload, CRC-16 little-endian), then 0x00.

Consistent Overhead Byte Stuffing gives bytes without 0x00, so that 0x00 can end a frame. Source: Cheshire and
Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM ToN 7(2), 1999.
"""

import binascii
from collections.abc import Iterator
from dataclasses import dataclass

from cartpole_rl.errors import FrameError
from cartpole_rl.wire.messages import MESSAGES, Message

VERSION = 2
OTHER_VERSION = "protocol version"  # in the FrameError for a frame of another version
END = b"\x00"
HEADER_BYTES = 4
CRC_BYTES = 2
LONGEST_BLOCK = 0xFF  # code byte of a block of 254 data bytes that is not followed by a zero
LONGEST_FRAME = 64  # stuffed bytes without the final 0x00; INFO, the longest message, takes 34


@dataclass(frozen=True)
class Frame:
    """A message with its sequence and flags."""

    message: Message
    sequence: int
    flags: int = 0


@dataclass(frozen=True)
class Envelope:
    """A frame with a right checksum whose version, type and payload are not checked yet."""

    version: int
    kind: int
    sequence: int
    flags: int
    payload: bytes


def encode_frame(message: Message, sequence: int, flags: int = 0) -> bytes:
    """Return the bytes for the wire, including the final 0x00. `sequence` is taken modulo 256."""
    body = bytes((VERSION, message.TYPE, sequence & 0xFF, flags)) + message.pack()
    return stuff(body + crc16(body).to_bytes(CRC_BYTES, "little")) + END


def open_envelope(stuffed: bytes) -> Envelope:
    """Return the header and payload in `stuffed`, which does not include the final 0x00.

    A cart needs them to refuse a frame with a reason. Raises FrameError for wrong stuffing, a frame that is
    cut short or a wrong checksum.
    """
    data = unstuff(stuffed)
    if len(data) < HEADER_BYTES + CRC_BYTES:
        raise FrameError(f"a frame of {len(data)} bytes is cut short")
    body, checksum = data[:-CRC_BYTES], int.from_bytes(data[-CRC_BYTES:], "little")
    if crc16(body) != checksum:
        raise FrameError(f"checksum {checksum:#06x} is not {crc16(body):#06x}")
    version, kind, sequence, flags = body[:HEADER_BYTES]
    return Envelope(version, kind, sequence, flags, body[HEADER_BYTES:])


def decode_frame(stuffed: bytes) -> Frame:
    """Return the frame in `stuffed`, which does not include the final 0x00.

    Raises FrameError for wrong stuffing, a frame that is cut short, a wrong checksum, another version, an
    unknown type or a wrong payload length.
    """
    envelope = open_envelope(stuffed)
    if envelope.version != VERSION:
        raise FrameError(f"it speaks {OTHER_VERSION} {envelope.version}, this program {VERSION}")
    if envelope.kind not in MESSAGES:
        raise FrameError(f"unknown message type {envelope.kind:#04x}")
    return Frame(MESSAGES[envelope.kind].unpack(envelope.payload), envelope.sequence, envelope.flags)


class FrameSplitter:
    """Splits a byte stream at each 0x00. Memory is bounded: overlong runs are dropped up to the next 0x00."""

    def __init__(self) -> None:
        self.pending = bytearray()  # of a frame whose 0x00 has not arrived
        self._dropping = False
        self.overlong = 0  # runs dropped so far

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield each complete stuffed frame without its 0x00; skip empty ones."""
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


def crc16(data: bytes) -> int:
    """Return CRC-16/IBM-3740 of `data`, alias CCITT-FALSE; of "123456789" it is 0x29B1.

    Polynomial 0x1021, start 0xFFFF, not reflected, no final xor. Source: the CRC catalogue.
    """
    return binascii.crc_hqx(data, 0xFFFF)


def stuff(data: bytes) -> bytes:
    """Return `data` without zeros; it is one byte longer for data of up to 254 bytes."""
    stuffed = bytearray()
    parts = data.split(b"\x00")
    for part in parts:
        while len(part) >= LONGEST_BLOCK - 1:
            stuffed.append(LONGEST_BLOCK)
            stuffed += part[: LONGEST_BLOCK - 1]
            part = part[LONGEST_BLOCK - 1 :]
        stuffed.append(len(part) + 1)
        stuffed += part
    if parts[-1] and not part:  # a full block ends the data: no block after it
        del stuffed[-1]
    return bytes(stuffed)


def unstuff(stuffed: bytes) -> bytes:
    """Return the data that was encoded. Raises FrameError if a block is cut short or contains a zero."""
    if not stuffed or 0 in stuffed:
        raise FrameError("stuffed bytes are empty or contain a zero")
    data = bytearray()
    at = 0
    while at < len(stuffed):
        code = stuffed[at]
        block = stuffed[at + 1 : at + code]
        if len(block) != code - 1:
            raise FrameError(f"block of {code - 1} bytes is cut short at {len(block)}")
        data += block
        at += code
        if code != LONGEST_BLOCK and at < len(stuffed):
            data.append(0)
    return bytes(data)
