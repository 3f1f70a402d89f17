"""Frames, messages and byte stuffing: round trips, detection of damage, published vectors.

A splitter stays synchronized and bounded; the cart's ticks and clock wrap at 2^32.
"""

from dataclasses import fields

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cartpole_rl.errors import FrameError
from cartpole_rl.wire.frames import (
    LONGEST_FRAME,
    Frame,
    FrameSplitter,
    crc16,
    decode_frame,
    encode_frame,
    open_envelope,
    stuff,
    unstuff,
)
from cartpole_rl.wire.messages import (
    MESSAGES,
    Hello,
    Message,
    MessageType,
    SetMotor,
    State,
    microseconds_between,
    seconds_between,
    ticks_between,
    went_back,
)

LIMITS = {"B": (0, 255), "h": (-(2**15), 2**15 - 1), "H": (0, 2**16 - 1)}
LIMITS |= {"i": (-(2**31), 2**31 - 1), "I": (0, 2**32 - 1)}


def messages() -> st.SearchStrategy[Message]:
    kinds = [
        st.builds(kind, *(st.integers(*LIMITS[letter]) for letter in kind.LAYOUT))
        for kind in MESSAGES.values()
    ]
    return st.one_of(kinds)


def frame_of(body: bytes) -> bytes:
    return stuff(body + crc16(body).to_bytes(2, "little"))


@given(messages(), st.integers(0, 255), st.integers(0, 255))
def test_every_message_round_trips(message, sequence, flags):
    frame = encode_frame(message, sequence, flags)
    assert frame.count(0) == 1
    assert frame[-1] == 0
    assert len(frame) - 1 <= LONGEST_FRAME
    assert decode_frame(frame[:-1]) == Frame(message, sequence, flags)


def test_each_type_has_one_message_and_a_layout_as_long_as_its_fields():
    assert set(MESSAGES) == set(MessageType)
    for kind in MESSAGES.values():
        assert len(kind.LAYOUT) == len(fields(kind))


def test_a_value_too_wide_for_its_field_is_refused():
    with pytest.raises(FrameError, match="SET_MOTOR"):
        encode_frame(SetMotor(40000), 0)


@given(messages(), st.data())
def test_every_wrong_byte_is_detected(message, data):
    body = bytearray(unstuff(encode_frame(message, 3)[:-1]))
    body[data.draw(st.integers(0, len(body) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(FrameError):
        decode_frame(stuff(bytes(body)))


@pytest.mark.parametrize(
    "message", [Hello(), SetMotor(-200), State(1169, 23380000, 43, 2051, -200, 4, 0, 20)]
)
def test_every_cut_is_detected(message):
    stuffed = encode_frame(message, 3)[:-1]
    for length in range(len(stuffed)):
        with pytest.raises(FrameError):
            decode_frame(stuffed[:length])


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        (b"\x01\x01\x00\x00", "version 1, this program 2"),
        (b"\x02\x7f\x00\x00", "unknown message type 0x7f"),
        (b"\x02\x04\x00\x00\x01", "SET_MOTOR has 1 payload bytes, not 6"),
        (b"\x02\x01", "cut short"),
    ],
)
def test_valid_frames_with_invalid_content_are_refused_by_name(body, complaint):
    with pytest.raises(FrameError, match=complaint):
        decode_frame(frame_of(body))


def test_an_envelope_opens_where_only_the_content_is_wrong():
    envelope = open_envelope(frame_of(b"\x02\x7f\x09\x00\x01"))
    assert (envelope.version, envelope.kind, envelope.sequence, envelope.payload) == (2, 0x7F, 9, b"\x01")


@given(st.lists(messages(), min_size=1, max_size=8), st.data())
def test_splitter_is_independent_of_how_bytes_arrive(sent, data):
    stream = b"".join(encode_frame(message, number) for number, message in enumerate(sent))
    splitter, came, at = FrameSplitter(), [], 0
    while at < len(stream):
        size = data.draw(st.integers(1, 40))
        came += [decode_frame(stuffed).message for stuffed in splitter.feed(stream[at : at + size])]
        at += size
    assert came == sent


@given(st.binary(max_size=300))
def test_splitter_is_synchronized_after_one_zero_after_any_garbage(garbage):
    splitter = FrameSplitter()
    list(splitter.feed(garbage + b"\x00"))
    assert list(splitter.feed(encode_frame(SetMotor(5), 1) * 2)) == [encode_frame(SetMotor(5), 1)[:-1]] * 2


def test_splitter_skips_empty_runs_and_stays_bounded():
    splitter = FrameSplitter()
    assert list(splitter.feed(b"\x00\x00\x00")) == []
    for _ in range(100):
        assert list(splitter.feed(b"\x55" * 1000)) == []
    assert len(splitter.pending) <= LONGEST_FRAME
    assert splitter.overlong == 1
    assert list(splitter.feed(b"\x00" + encode_frame(Hello(), 0))) == [encode_frame(Hello(), 0)[:-1]]


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
    assert stuff(data) == stuffed
    assert unstuff(stuffed) == data


@given(st.binary(max_size=800) | st.integers(0, 800).map(lambda length: b"\x07" * length))
def test_round_trip_has_no_zero_and_bounded_overhead(data):
    stuffed = stuff(data)
    assert 0 not in stuffed
    assert len(stuffed) <= len(data) + 1 + len(data) // 254
    assert unstuff(stuffed) == data


@pytest.mark.parametrize("stuffed", [b"", b"\x05\x11", b"\x02", b"\x02\x00", b"\xff\x01"])
def test_bytes_that_no_encoder_makes_are_refused(stuffed):
    with pytest.raises(FrameError):
        unstuff(stuffed)


def test_checksum_of_the_catalogue():
    assert crc16(b"123456789") == 0x29B1
    assert crc16(b"") == 0xFFFF


@pytest.mark.parametrize(
    ("before", "after", "difference"), [(5, 7, 2), (2**32 - 1, 1, 2), (7, 7, 0), (7, 5, 2**32 - 2)]
)
def test_differences_are_right_across_the_wrap(before: int, after: int, difference: int) -> None:
    assert ticks_between(before, after) == difference
    assert microseconds_between(before, after) == difference
    assert seconds_between(before, after) == pytest.approx(difference * 1e-6)


def test_an_older_number_is_recognized() -> None:
    assert went_back(ticks_between(7, 5))
    assert went_back(ticks_between(3, 2**32 - 3))
    assert not went_back(ticks_between(5, 7))
    assert not went_back(ticks_between(2**32 - 3, 3))
    assert not went_back(ticks_between(7, 7))
