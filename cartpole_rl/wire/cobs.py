"""Consistent Overhead Byte Stuffing: bytes without 0x00, so that 0x00 can end a frame.

Source: Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM ToN 7(2), 1999.
"""

from cartpole_rl.errors import FrameError

LONGEST_BLOCK = 0xFF  # a code byte of 0xFF: 254 data bytes follow and no zero stands after them


def encode(data: bytes) -> bytes:
    """`data` with every zero replaced; one byte longer for data of up to 254 bytes."""
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
    """The data that `encode` was given. Raises FrameError where a block is cut short or holds a zero."""
    if not stuffed or 0 in stuffed:
        raise FrameError("stuffed bytes are empty or hold a zero")
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
