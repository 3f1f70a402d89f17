"""The firmware under test, "python" or "c". The fixture `each_firmware` runs tests with both."""

import shutil
from collections.abc import Callable

import pytest

from cartpole_rl.emulator.c_firmware import CFirmware
from cartpole_rl.emulator.c_library import COMPILERS
from cartpole_rl.emulator.firmware import Firmware
from cartpole_rl.emulator.settings import EmulatorSettings

KINDS: dict[str, type[Firmware] | type[CFirmware]] = {"python": Firmware, "c": CFirmware}
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
