"""Consistent Overhead Byte Stuffing: bytes without 0x00, so that 0x00 can end a frame.

Source: Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM ToN 7(2), 1999.
"""

from cartpole_rl.errors import FrameError

LONGEST_BLOCK = 0xFF  # code byte of a block of 254 data bytes that is not followed by a zero


def encode(data: bytes) -> bytes:
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


def decode(stuffed: bytes) -> bytes:
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
