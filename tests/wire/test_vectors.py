"""The host's encoder and decoder agree with every frame of tests/wire/vectors.json."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from cartpole_rl.errors import FrameError
from cartpole_rl.wire.frames import FrameSplitter, decode_frame, encode_frame
from cartpole_rl.wire.messages import MESSAGES, MessageType, Reason

VECTORS = json.loads((Path(__file__).parent / "vectors.json").read_text(encoding="utf-8"))
GOOD, DAMAGED, DIALOGUE = VECTORS["good"], VECTORS["damaged"], VECTORS["dialogue"]


def named(vectors: list[dict]) -> list:
    return [pytest.param(vector, id=vector["name"]) for vector in vectors]


@pytest.mark.parametrize("vector", named(GOOD))
def test_a_good_frame_is_encoded_and_decoded(vector):
    wire = bytes.fromhex(vector["hex"])
    message = MESSAGES[MessageType[vector["type"]]](**vector["fields"])
    assert encode_frame(message, vector["sequence"], vector["flags"]) == wire
    frame = decode_frame(wire[:-1])
    assert (frame.message, frame.sequence, frame.flags) == (message, vector["sequence"], vector["flags"])
    assert asdict(frame.message) == vector["fields"]


@pytest.mark.parametrize("vector", named(DAMAGED))
def test_a_damaged_frame_is_dropped_and_the_next_one_is_not(vector):
    splitter = FrameSplitter()
    hello = encode_frame(MESSAGES[MessageType.HELLO](), 9)
    *damaged, last = splitter.feed(bytes.fromhex(vector["hex"]) + hello)
    assert last == hello[:-1]
    for stuffed in damaged:
        with pytest.raises(FrameError):
            decode_frame(stuffed)


def test_every_type_and_every_refusal_is_there():
    assert {vector["type"] for vector in GOOD} == {kind.name for kind in MessageType}
    reasons = {vector["fields"]["reason"] for vector in GOOD if vector["type"] == "NACK"}
    assert reasons == {reason.value for reason in Reason}
