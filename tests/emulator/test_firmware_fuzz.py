"""Arbitrary bytes on either side of the wire cause no error, no motion, no arming and no growing memory.

scripts/fuzz/wire.py is the long version.
"""

import contextlib

import pytest
from firmwares import make_firmware, motors_over, one_firmware
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cartpole_rl.emulator.firmware import BANNER
from cartpole_rl.errors import FrameError
from cartpole_rl.wire.frames import (
    LONGEST_FRAME,
    Envelope,
    FrameSplitter,
    decode_frame,
    encode_frame,
    open_envelope,
)
from cartpole_rl.wire.messages import MESSAGES, Flags, Home, Message, SetMotor, Start, State

pytestmark = pytest.mark.usefixtures("each_firmware")

FRAMES = [encode_frame(message, 3)[:-1] for message in (Start(), Home(), SetMotor(200), SetMotor(-1))]
FRAMES.append(encode_frame(State(1169, 23380000, 43, 2051, -200, 4, 0, 20), 148, 3)[:-1])
BITS = {"B": 8, "h": 16, "H": 16, "i": 32, "I": 32}


@st.composite
def mutated(draw: st.DrawFn) -> bytes:
    """Draw a frame with a few bytes changed, inserted and deleted, including its final 0x00."""
    frame = bytearray(draw(st.sampled_from(FRAMES)))
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(frame)))
        frame[at : at + draw(st.integers(0, 3))] = draw(st.binary(max_size=3))
    return bytes(frame) + b"\x00"


def streams() -> st.SearchStrategy[bytes]:
    return st.lists(st.binary(max_size=200) | mutated() | st.just(BANNER), max_size=12).map(b"".join)


def envelope(stuffed: bytes) -> Envelope | None:
    """Return the envelope of a run of bytes if its checksum is right."""
    with contextlib.suppress(FrameError):
        return open_envelope(stuffed)
    return None


@one_firmware
@given(streams())
@settings(max_examples=150)
def test_the_hosts_decoder_takes_any_bytes(stream):
    splitter = FrameSplitter()
    for stuffed in splitter.feed(stream):
        assert 0 < len(stuffed) <= LONGEST_FRAME
        try:
            frame = decode_frame(stuffed)
        except FrameError:
            continue
        assert encode_frame(frame.message, frame.sequence, frame.flags)
    assert len(splitter.pending) <= LONGEST_FRAME


@given(streams())
@example(b"".join(frame + b"\x00" for frame in FRAMES))
@settings(max_examples=150)
def test_a_disarmed_cart_stays_still_and_disarmed_under_any_bytes(stream):
    firmware, splitter = make_firmware(lambda: 0, homed=True), FrameSplitter()
    for stuffed in splitter.feed(stream):
        opened = envelope(stuffed)
        if opened is not None and opened.kind in (Start.TYPE, Home.TYPE):
            continue  # a valid frame, which may move a cart
        answers = firmware.receive(stuffed, 0)
        assert opened is not None or answers == []
        assert len(answers) <= 1
    assert not firmware.armed
    assert not firmware.homing
    assert {value for _, value in motors_over(firmware, 0, 20_000)} == {0}
    assert decode_frame(firmware.tick(20_000, 0, 0)[-1][:-1]).message.motor_applied == 0
    assert len(splitter.pending) <= LONGEST_FRAME


def test_no_start_with_one_wrong_byte_arms():
    firmware = make_firmware(lambda: 0, homed=True)
    for sequence in (0, 1, 3, 128, 255):
        frame = encode_frame(Start(), sequence)[:-1]
        for at in range(len(frame)):
            for wrong in set(range(256)) - {frame[at]}:
                for stuffed in FrameSplitter().feed(frame[:at] + bytes([wrong]) + frame[at + 1 :] + b"\x00"):
                    assert firmware.receive(stuffed, 0) == []
    assert not firmware.armed


def any_host_message() -> st.SearchStrategy[Message]:
    kinds = [kind for kind in MESSAGES.values() if kind.TYPE < 0x80]
    return st.one_of([st.builds(kind, *map(any_number, kind.LAYOUT)) for kind in kinds])


def any_number(letter: str) -> st.SearchStrategy[int]:
    bits, signed = BITS[letter], letter.islower()
    return st.integers(-(2 ** (bits - 1)) if signed else 0, 2 ** (bits - signed) - 1)


@given(st.lists(any_host_message() | st.integers(-40_000, 40_000), max_size=40), st.booleans())
@settings(max_examples=150)
def test_a_cart_that_is_neither_armed_nor_homing_is_at_most_braked(events, homed):
    """Valid frames in any order, between periods that end at any count (an int)."""
    firmware, now_us, braked = make_firmware(lambda: 3_000, homed), 0, False
    for event in events:
        if isinstance(event, Message):
            firmware.receive(encode_frame(event, 1)[:-1], now_us)
            braked |= firmware.armed  # the brake of a cart that is armed and stopped at once goes on
            continue
        idle = not firmware.armed and not firmware.homing
        end_us = now_us + firmware.period_us
        values = motors_over(firmware, now_us, end_us)
        assert not idle or values[-1][1] == 0 or braked
        now_us = end_us
        state = decode_frame(firmware.tick(now_us, event, event)[-1][:-1])
        motor, braked = state.message.motor_applied, bool(Flags(state.flags) & Flags.SOFT_LIMIT)
        assert abs(motor) <= 255
        if not firmware.armed and not firmware.homing:
            assert motor == 0 or (braked and abs(motor) == 255)
