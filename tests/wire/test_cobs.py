"""Byte stuffing: published vectors, round trips, and refusal of invalid input."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cartpole_rl.errors import FrameError
from cartpole_rl.wire import cobs
from cartpole_rl.wire.frames import crc16


def span(first: int, last: int) -> bytes:
    return bytes(range(first, last + 1))


VECTORS = [  # from Cheshire and Baker's paper and the list that implementations commonly share
    (b"", b"\x01"),
    (b"\x00", b"\x01\x01"),
    (b"\x00\x00", b"\x01\x01\x01"),
    (b"\x00\x11\x00", b"\x01\x02\x11\x01"),
    (b"\x11\x22\x00\x33", b"\x03\x11\x22\x02\x33"),
    (b"\x11\x22\x33\x44", b"\x05\x11\x22\x33\x44"),
    (b"\x11\x00\x00\x00", b"\x02\x11\x01\x01\x01"),
    (span(1, 254), b"\xff" + span(1, 254)),
    (b"\x00" + span(1, 254), b"\x01\xff" + span(1, 254)),
    (span(1, 255), b"\xff" + span(1, 254) + b"\x02\xff"),
    (span(2, 255) + b"\x00", b"\xff" + span(2, 255) + b"\x01\x01"),
    (span(3, 255) + b"\x00\x01", b"\xfe" + span(3, 255) + b"\x02\x01"),
]


@pytest.mark.parametrize(("data", "stuffed"), VECTORS)
def test_published_vectors_both_ways(data, stuffed):
    assert cobs.encode(data) == stuffed
    assert cobs.decode(stuffed) == data


@given(st.binary(max_size=800) | st.integers(0, 800).map(lambda length: b"\x07" * length))
def test_round_trip_has_no_zero_and_bounded_overhead(data):
    stuffed = cobs.encode(data)
    assert 0 not in stuffed
    assert len(stuffed) <= len(data) + 1 + len(data) // 254
    assert cobs.decode(stuffed) == data


@pytest.mark.parametrize("stuffed", [b"", b"\x05\x11", b"\x02", b"\x02\x00", b"\xff\x01"])
def test_bytes_that_no_encoder_makes_are_refused(stuffed):
    with pytest.raises(FrameError):
        cobs.decode(stuffed)


def test_checksum_of_the_catalogue():
    assert crc16(b"123456789") == 0x29B1
    assert crc16(b"") == 0xFFFF
