"""The C firmware: the vectors of the wire, strict compilation, and a machine without a compiler."""

import ctypes
import json
import os
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path

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
from cartpole_rl.wire import FrameSplitter, MessageType
from cartpole_rl.wire.messages import MESSAGES

pytestmark = needs_compiler
PATH = Path(__file__).parents[1] / "wire" / "vectors.json"
VECTORS = json.loads(PATH.read_text(encoding="utf-8"))
LONGEST_RUN = 64
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wshadow", "-Werror")


class EnvelopeInC(ctypes.Structure):
    """`cart_envelope` of firmware/src/cart_frames.h."""

    _fields_ = (
        ("header", ctypes.c_uint8 * 4),
        ("payload", ctypes.c_uint8 * LONGEST_RUN),
        ("payload_length", ctypes.c_size_t),
    )


class SplitterInC(ctypes.Structure):
    """`cart_splitter` of firmware/src/cart_frames.h."""

    _fields_ = (
        ("run", ctypes.c_uint8 * LONGEST_RUN),
        ("length", ctypes.c_size_t),
        ("dropping", ctypes.c_bool),
    )


def runs_in_c(stream: bytes) -> list[bytes]:
    """Return the runs of bytes that the splitter of the C firmware finds."""
    library, splitter, length, runs = load_library(), SplitterInC(), ctypes.c_size_t(), []
    library.cart_split.restype = ctypes.c_bool
    for byte in stream:
        if library.cart_split(ctypes.byref(splitter), ctypes.c_uint8(byte), ctypes.byref(length)):
            runs.append(bytes(splitter.run[: length.value]))
    return runs


def opened_in_c(stuffed: bytes) -> tuple[bytes, bytes] | None:
    """Return header and payload of a frame, or None for a damaged one."""
    library, envelope = load_library(), EnvelopeInC()
    library.cart_open.restype = ctypes.c_bool
    if not library.cart_open(stuffed, ctypes.c_size_t(len(stuffed)), ctypes.byref(envelope)):
        return None
    return bytes(envelope.header), bytes(envelope.payload[: envelope.payload_length])


def named(vectors: list[dict]) -> list:
    return [pytest.param(vector, id=vector["name"]) for vector in vectors]


@pytest.mark.parametrize("vector", named(VECTORS["good"]))
def test_a_good_frame_is_encoded_and_opened(vector):
    wire, kind = bytes.fromhex(vector["hex"]), MessageType[vector["type"]]
    payload = MESSAGES[kind](**vector["fields"]).pack()
    frame = ctypes.create_string_buffer(LONGEST_RUN)
    library = load_library()
    library.cart_frame.restype = ctypes.c_size_t
    length = library.cart_frame(
        int(kind), vector["sequence"], vector["flags"], payload, ctypes.c_size_t(len(payload)), frame
    )
    assert frame.raw[:length] == wire
    (run,) = runs_in_c(wire)
    assert opened_in_c(run) == (bytes((2, kind, vector["sequence"], vector["flags"])), payload)


@pytest.mark.parametrize("vector", named(VECTORS["damaged"]))
def test_a_damaged_frame_is_dropped_and_the_next_one_is_not(vector):
    stream = bytes.fromhex(vector["hex"]) + bytes.fromhex(VECTORS["good"][0]["hex"])
    *damaged, last = runs_in_c(stream)
    assert [*damaged, last] == list(FrameSplitter().feed(stream))
    assert all(opened_in_c(run) is None for run in damaged)
    assert opened_in_c(last) is not None


def test_the_head_of_a_cart_is_where_python_expects_it():
    """HOME, refused by nobody, changes the flags that Python reads and writes by their place."""
    firmware = CFirmware(lambda: 0, zero_error=-7)
    assert (firmware.period_us, firmware.armed, firmware.homed, firmware.homing) == (
        20_000,
        False,
        False,
        False,
    )
    firmware.homed = True
    names = ("period_us", "armed", "homed", "homing", "fault")
    assert [int(getattr(firmware, name)) for name in names] == firmware.snapshot[:5] == [20_000, 0, 1, 0, 0]
    assert firmware._head.pole_trim == -7
    assert load_library().cart_size() > ctypes.sizeof(CartHead)
    assert len(firmware.snapshot) == SNAPSHOT_NUMBERS


@pytest.mark.parametrize("file", [path.name for path in sorted(firmware_folder().glob("src/*.c"))])
def test_a_file_compiles_without_a_warning_and_with_the_numbers_of_a_board(file, tmp_path):
    command = [find_compiler(), *STRICT, "-O2", "-c", f"src/{file}", "-o", str(tmp_path / "object.o")]
    done = subprocess.run(command, cwd=firmware_folder(), capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_library_compiles_without_a_warning(tmp_path):
    compile_c(tmp_path / "library.so", c_firmware.sources(), "-shared", "-fPIC", *STRICT[1:])


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
    first = c_firmware.build_library()
    written = first.stat().st_mtime_ns
    assert c_firmware.build_library() == first
    assert first.stat().st_mtime_ns == written
    other = nominal_hardware().model_copy(update={"hard_push": 199})
    assert c_firmware.build_library(hardware=nominal_hardware()) == first
    assert c_firmware.build_library(hardware=other) != first
    monkeypatch.setattr(c_firmware, "FLAGS", (*c_firmware.FLAGS, "-DCART_OTHER=1"))
    assert c_firmware.build_library() != first


def test_the_shipped_header_is_that_of_ip02():
    """Write it again after a change: cartpole-export format=firmware cart=ip02."""
    shipped = (firmware_folder() / "src" / "cart_rig.h").read_text(encoding="utf-8")
    assert shipped == rig_header(nominal_hardware(), "ip02")
    assert [*c_firmware.RIG] == re.findall(r"#ifndef (?!CART_RIG_H)(\w+)", shipped)
