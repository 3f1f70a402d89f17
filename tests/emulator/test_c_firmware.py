"""The C firmware: strict compilation, a machine without a compiler, the same drive as in Python."""

import ctypes
import os
import re
import subprocess
import sys
from contextlib import closing

import pytest
from firmwares import needs_compiler

from cartpole_rl.emulator import c_firmware
from cartpole_rl.emulator.c_firmware import (
    SNAPSHOT_NUMBERS,
    CartHead,
    CFirmware,
    compile_c,
    find_compiler,
    firmware_folder,
    load_library,
    rig_header,
)
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import EmulatorError
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.rig.hardware import nominal_hardware

pytestmark = needs_compiler
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wshadow", "-Werror")


def test_the_head_of_a_cart_is_where_python_expects_it():
    """HOME, refused by nobody, changes the flags that Python reads and writes by their place."""
    firmware = CFirmware(lambda: 0, zero_error=-7)
    names = ("period_us", "armed", "homed", "homing", "fault")
    for expected in ([20_000, 0, 0, 0, 0], [20_000, 0, 1, 0, 0]):
        assert [int(getattr(firmware, name)) for name in names] == firmware.snapshot[:5] == expected
        firmware.homed = True
    assert firmware._head.pole_trim == -7
    assert load_library().cart_size() > ctypes.sizeof(CartHead)
    assert len(firmware.snapshot) == SNAPSHOT_NUMBERS


def test_each_file_compiles_without_a_warning_and_with_the_numbers_of_a_board(tmp_path):
    folder = firmware_folder()
    command = [find_compiler(), *STRICT, "-O2", "-Isrc", "-c", "-o", str(tmp_path / "object.o")]
    for path in (*sorted(folder.glob("src/*.c")), folder / "host" / "library.c"):
        done = subprocess.run([*command, str(path)], cwd=folder, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, ""), path.name


def test_a_driven_cart_sends_and_takes_the_same_with_both(tmp_path):
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    counts = {}
    for kind in ("python", "c"):
        truth = {"firmware": kind, "journal": tmp_path / kind, "latency": 0.012, "physics_step": 1e-3}
        with closing(emulated_plant(EmulatorSettings(**truth))) as plant:
            frames = [plant.reset_one()]
            for step in range(150):
                if frames[-1].ends:
                    break
                frames.append(plant.step_one(200 if step // 12 % 2 else -200))
            frames.append(plant.reset_one())  # the host brings it back to the middle
        counts[kind] = [frame.counts for frame in frames]
    journals = [(tmp_path / kind).read_text() for kind in counts]
    assert counts["python"] == counts["c"]
    assert journals[0] == journals[1]
    assert len(journals[0]) > 1000


def test_a_cart_without_a_compiler_ends_with_one_line():
    command = [sys.executable, "-m", "cartpole_rl.emulator", '{"firmware": "c"}']
    environment = {name: value for name, value in os.environ.items() if name != "CC"} | {"PATH": ""}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert line.startswith("emulator.firmware=c needs a C compiler")


def test_code_that_does_not_compile_is_an_error(tmp_path):
    wrong = tmp_path / "wrong.c"
    wrong.write_text("int main(void) { return nothing; }\n")
    with pytest.raises(EmulatorError, match="nothing"):
        compile_c(tmp_path / "wrong", [wrong])


def test_a_library_is_built_once_and_again_for_other_sources(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    built = []
    monkeypatch.setattr(c_firmware, "compile_c", lambda output, *words: built.append(output.touch()))
    first = c_firmware.build_library()
    assert c_firmware.build_library() == c_firmware.build_library(hardware=nominal_hardware()) == first
    assert len(built) == 1
    other = nominal_hardware().model_copy(update={"hard_push": 199})
    assert c_firmware.build_library(hardware=other) != first
    monkeypatch.setattr(c_firmware, "FLAGS", (*c_firmware.FLAGS, "-DCART_OTHER=1"))
    assert c_firmware.build_library() != first
    assert len(built) == 3


def test_the_shipped_header_is_that_of_ip02():
    """Write it again after a change: cartpole-export format=firmware cart=ip02."""
    shipped = (firmware_folder() / "src" / "cart_rig.h").read_text(encoding="utf-8")
    assert shipped == rig_header(nominal_hardware(), "cart=ip02")
    assert rig_header(nominal_hardware(), "cart=/*/\n*/mine.yaml").count("*/") == shipped.count("*/")
    assert [*c_firmware.RIG] == re.findall(r"#ifndef (?!CART_RIG_H)(\w+)", shipped)
