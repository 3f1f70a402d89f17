"""A cart that has just booted answers tests/wire/vectors.json byte for byte."""

import json
from pathlib import Path

import pytest
from firmwares import make_firmware

from cartpole_rl.wire.frames import FrameSplitter

pytestmark = pytest.mark.usefixtures("each_firmware")

PATH = Path(__file__).parents[1] / "wire" / "vectors.json"
VECTORS = json.loads(PATH.read_text(encoding="utf-8"))


def test_a_booted_cart_answers_according_to_the_vectors():
    firmware, splitter = make_firmware(lambda: 0), FrameSplitter()
    for vector in VECTORS["dialogue"]:
        runs = splitter.feed(bytes.fromhex(vector["send"]))
        answer = b"".join(frame for stuffed in runs for frame in firmware.receive(stuffed, 0))
        assert answer.hex(" ") == vector["answer"], vector["name"]


@pytest.mark.parametrize("vector", [pytest.param(one, id=one["name"]) for one in VECTORS["damaged"]])
def test_a_damaged_frame_gets_no_answer(vector):
    firmware = make_firmware(lambda: 0, homed=True)
    for stuffed in FrameSplitter().feed(bytes.fromhex(vector["hex"])):
        assert firmware.receive(stuffed, 0) == []
    assert not firmware.armed
