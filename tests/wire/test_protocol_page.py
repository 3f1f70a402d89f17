"""The numbers in docs/protocol.md are those of the code."""

import re
from pathlib import Path

import pytest

from cartpole_rl.wire import (
    Ack,
    ClearFault,
    Fault,
    FaultReport,
    Flags,
    Hello,
    Home,
    Info,
    Message,
    MessageType,
    Nack,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    StartPolicy,
    State,
    Stop,
    encode_frame,
)
from cartpole_rl.wire.frames import CRC_BYTES, HEADER_BYTES, LONGEST_FRAME

PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
HOMED = Flags.HOMED
EXAMPLES: dict[str, tuple[Message, int, int]] = {
    "HELLO": (Hello(), 0, 0),
    "INFO": (Info(2, 0, 0, 4096, 22749, 255, 16704, 17539, 20000, 0), 0, 0),
    "SET_PERIOD": (SetPeriod(20000), 1, 0),
    "HOME": (Home(), 2, 0),
    "ACK": (Ack(2, MessageType.HOME), 5, Flags.HOMING),
    "START": (Start(), 3, 0),
    "SET_MOTOR": (SetMotor(-200, 1168), 4, 0),
    "STATE": (State(1169, 23380000, 43, 2051, -200, 4, 0, 20), 148, Flags.ARMED | HOMED),
    "STOP": (Stop(), 5, 0),
    "NACK": (Nack(6, MessageType.SET_MOTOR, Reason.NOT_ARMED), 150, HOMED),
    "FAULT": (FaultReport(Fault.HARD_LIMIT, 1200), 160, HOMED | Flags.FAULTED),
    "CLEAR_FAULT": (ClearFault(), 7, 0),
    "START_POLICY": (StartPolicy(), 8, 0),
}
ROWS = dict(re.findall(r"^\| ([A-Z_]+)\b.*\| `((?:[0-9a-f]{2} )+00)` \|$", PAGE, re.MULTILINE))


def test_every_type_flag_fault_and_reason_is_listed():
    assert set(ROWS) == set(EXAMPLES) == {kind.name for kind in MessageType}
    rows = [f"| {kind.value:#04x} | {kind.name}" for kind in MessageType]
    rows += [f"| {flag.name} | {flag.value:#04x} |" for flag in Flags]
    rows += [f"| {fault.name} | {fault.value:#06x} |" for fault in Fault]
    rows += [f"| {reason.value} {reason.name} |" for reason in Reason]
    assert [row for row in rows if row not in PAGE] == []


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_has_the_bytes_of_the_encoder(name):
    assert ROWS[name] == encode_frame(*EXAMPLES[name]).hex(" ")


@pytest.mark.parametrize("name", ["STATE", "SET_MOTOR"])
def test_the_length_of_a_frame_is_stated(name):
    stated = int(re.search(rf"\b{name} is (\d+) bytes", PAGE).group(1))
    assert stated == len(encode_frame(*EXAMPLES[name]))


def test_the_longest_message_fits_a_frame():
    """INFO has 27 bytes of payload, and 6 of header and checksum; stuffing adds one."""
    lengths = {name: len(encode_frame(*example)) - 1 for name, example in EXAMPLES.items()}
    longest = max(lengths.values())
    assert {name for name, length in lengths.items() if length == longest} == {"INFO"}
    assert longest == 27 + HEADER_BYTES + CRC_BYTES + 1 < LONGEST_FRAME


@pytest.mark.parametrize("rule", ["Watchdog", "Soft limit", "Faults"])
def test_each_rule_says_when_it_holds(rule):
    """Homing touches the stops, so the page must state these exceptions."""
    text = re.search(rf"^\d\. \*\*{rule}\*\*(.*?)(?=^\d\. |^$)", PAGE, re.MULTILINE | re.DOTALL).group(1)
    assert "while armed" in text
    assert "homing" in text


def test_the_limits_before_the_first_homing_are_stated():
    """The same numbers as in tests/emulator/test_emulator_device.py."""
    text = " ".join(PAGE.split("**The limits in INFO**")[1].split("\n\n")[0].split())
    assert "Before the first homing" in text
    assert "16704 and 17539" in text
