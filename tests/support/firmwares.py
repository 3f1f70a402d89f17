"""The firmware under test, "python" or "c". The fixture `each_firmware` runs tests with both."""

import shutil
from collections.abc import Callable
from dataclasses import replace

import pytest

from cartpole_rl.emulator.c_firmware import COMPILERS, CFirmware
from cartpole_rl.emulator.firmware import Firmware
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.wire.frames import Frame, decode_frame, encode_frame
from cartpole_rl.wire.messages import Flags, Message, Nack, Reason, SetMotor, State

KINDS: dict[str, type[Firmware] | type[CFirmware]] = {"python": Firmware, "c": CFirmware}
one_firmware = pytest.mark.parametrize("each_firmware", ["python"], indirect=True)  # of `each_firmware`
needs_compiler = pytest.mark.skipif(not any(map(shutil.which, COMPILERS)), reason="needs a C compiler")


class UnderTest:
    """The name of the firmware under test."""

    kind = "python"


def truth(**settings: object) -> EmulatorSettings:
    """Return the settings of an emulated cart with the firmware under test."""
    return EmulatorSettings(**{"firmware": UnderTest.kind} | settings)


def make_firmware(delay_us: Callable[[], int], homed: bool = False) -> Firmware | CFirmware:
    """Return a firmware of the kind under test, just booted; `homed` is set by hand."""
    firmware = KINDS[UnderTest.kind](delay_us)
    firmware.homed = homed
    return firmware


def answering(tick: int, message: Message) -> Message:
    """Return the message; a motor value that names no state answers that of `tick`."""
    return replace(message, tick=tick) if isinstance(message, SetMotor) and not message.tick else message


def motors_over(firmware: Firmware | CFirmware, start_us: int, end_us: int) -> list[tuple[int, int]]:
    """Drive a firmware from start to end; return the motor values in force as (since, value)."""
    values = [(start_us, firmware.motor)]
    while (due_us := firmware.next_due(end_us)) < end_us:
        firmware.drive(due_us)
        values.append((max(due_us, start_us), firmware.motor))
    return values


class Bench:
    """A firmware whose encoder counts a test sets."""

    def __init__(self, latency_us: int = 0, homed: bool = True) -> None:
        self.firmware = make_firmware(lambda: latency_us, homed)
        self.now_us = 0
        self.sequence = self.ticks = 0

    def send(self, message: Message) -> Message | None:
        """Send a message; return the answer or None."""
        frame = encode_frame(answering(self.ticks, message), self.sequence)[:-1]
        self.sequence = (self.sequence + 1) & 0xFF
        answers = [decode_frame(answer[:-1]).message for answer in self.firmware.receive(frame, self.now_us)]
        assert len(answers) <= 1
        return answers[0] if answers else None

    def refusal(self, message: Message) -> Reason | None:
        """Send a message; return the reason of its refusal or None."""
        answer = self.send(message)
        return Reason(answer.reason) if isinstance(answer, Nack) else None

    def frames(self, cart: int = 0, pole: int = 0) -> list[Frame]:
        """Pass a period; return the frames at its end."""
        end = self.now_us + self.firmware.period_us
        self.motors = motors_over(self.firmware, self.now_us, end)
        self.now_us = end
        self.ticks += 1
        return [decode_frame(frame[:-1]) for frame in self.firmware.tick(end, cart, pole)]

    def tick(self, cart: int = 0, pole: int = 0) -> tuple[State, Flags]:
        """Pass a period; return its STATE and flags."""
        last = self.frames(cart, pole)[-1]
        assert isinstance(last.message, State)
        return last.message, Flags(last.flags)
