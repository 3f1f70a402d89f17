"""The firmware under test, "python" or "c". The fixture `each_firmware` runs tests with both."""

import shutil
from collections.abc import Callable
from dataclasses import replace

import pytest

from cartpole_rl.emulator.c_firmware import COMPILERS, CFirmware
from cartpole_rl.emulator.firmware import Firmware
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.wire.messages import Message, SetMotor

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
