"""The numbers in docs/protocol.md are those of the code, and its examples are in tests/wire/vectors.json."""

import json
import re
from pathlib import Path

import pytest

from cartpole_rl.wire.frames import CRC_BYTES, HEADER_BYTES, LONGEST_FRAME, encode_frame
from cartpole_rl.wire.messages import Fault, FaultReport, Flags, MessageType, Reason

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
VECTORS = json.loads((Path(__file__).parent / "vectors.json").read_text(encoding="utf-8"))["good"]
TYPES = {vector["hex"]: vector["type"] for vector in VECTORS}
FAULT = encode_frame(FaultReport(Fault.HARD_LIMIT, 1200), 160, Flags.HOMED | Flags.FAULTED)
TYPES[FAULT.hex(" ")] = "FAULT"
ROWS = dict(re.findall(r"^\| ([A-Z_]+)\b.*\| `((?:[0-9a-f]{2} )+00)` \|$", PAGE, re.MULTILINE))


def test_every_type_flag_fault_and_reason_is_listed():
    assert set(ROWS) == {kind.name for kind in MessageType}
    rows = [f"| {kind.value:#04x} | {kind.name}" for kind in MessageType]
    rows += [f"| {flag.name} | {flag.value:#04x} |" for flag in Flags]
    rows += [f"| {fault.name} | {fault.value:#06x} |" for fault in Fault]
    rows += [f"| {reason.value} {reason.name} |" for reason in Reason]
    assert [row for row in rows if row not in PAGE] == []


def test_each_example_is_a_frame_of_its_type():
    assert {name: TYPES.get(row) for name, row in ROWS.items()} == {name: name for name in ROWS}


def test_lengths_of_frames_are_stated_and_the_longest_fits():
    """INFO has 27 bytes of payload, and 6 of header and checksum; stuffing adds one."""
    lengths = {name: len(bytes.fromhex(row)) for name, row in ROWS.items()}
    for name in ("STATE", "SET_MOTOR"):
        assert int(re.search(rf"\b{name} is (\d+) bytes", PAGE).group(1)) == lengths[name]
    assert max(lengths, key=lengths.get) == "INFO"
    assert lengths["INFO"] - 1 == 27 + HEADER_BYTES + CRC_BYTES + 1 < LONGEST_FRAME


@pytest.mark.parametrize("rule", ["Watchdog", "Soft limit", "Faults"])
def test_each_rule_says_when_it_holds(rule):
    """Homing touches the stops, so the page must state these exceptions."""
    text = re.search(rf"^\d\. \*\*{rule}\*\*(.*?)(?=^\d\. |^$)", PAGE, re.MULTILINE | re.DOTALL).group(1)
    assert "while armed" in text
    assert "homing" in text


def test_the_limits_before_the_first_homing_are_stated():
    """The same numbers as in tests/emulator/test_device.py."""
    text = " ".join(PAGE.split("**The limits in INFO**")[1].split("\n\n")[0].split())
    assert "Before the first homing" in text
    assert "16704 and 17539" in text
