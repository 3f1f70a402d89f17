"""The firmware compiles without a warning for the processors of boards, to a small program."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cartpole_rl.emulator.c_firmware import firmware_folder, rig_header
from cartpole_rl.rig.hardware import hardware_of

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Werror")
ARM = "arm-none-eabi-gcc"
SHUTTLE = Path(__file__).parents[1] / "support" / "shuttle"
LARGEST = {"text": 32_768, "bss": 4_096}  # bytes: a board of 32 kB RAM has plenty left for a policy

needs_arm = pytest.mark.skipif(
    not (shutil.which(ARM) and shutil.which("make")), reason=f"needs {ARM} and make: apt-get install"
)
needs_zig = pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None,
    reason="needs a C compiler for other processors: pip install ziglang",
)


def run_make(*words: object, folder: Path | None = None) -> "subprocess.CompletedProcess[str]":
    command = ["make", "-C", str(firmware_folder()), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder)


@needs_arm
@pytest.mark.parametrize("board", ["nucleo_f401re", "qemu_an386"])
def test_a_board_of_cortex_m_is_small_and_reads_only_the_end_switches_of_its_rig(
    board: str, tmp_path: Path
) -> None:
    header = rig_header(hardware_of({"right_switch": 1}), "a cart with a switch")
    (tmp_path / "rig.h").write_text(header)
    for words, symbols in (([f"RIG={tmp_path / 'rig.h'}"], 1), ([], 0)):
        done = run_make(f"BUILD={tmp_path}", board, *words)
        assert (done.returncode, done.stderr) == (0, "")
        assert (tmp_path / f"{board}.elf").read_bytes().count(b"cart_hardware_switches") == symbols
    sizes = re.search(r"text\s+data\s+bss.*\n\s*(?P<text>\d+)\s+\d+\s+(?P<bss>\d+)", done.stdout)
    assert sizes is not None
    assert {name: int(sizes[name]) <= limit for name, limit in LARGEST.items()} == {"text": True, "bss": True}


@needs_arm
def test_a_program_with_a_policy_does_not_take_the_place_of_the_one_without(tmp_path: Path) -> None:
    """A new policy.h is compiled; the plain program stays as it was and is not the one with the policy."""
    policy, other = (shutil.copytree(SHUTTLE, tmp_path / name) for name in ("policy", "other"))
    build, chosen = tmp_path / "build", f"POLICY={policy}"
    for words in ([chosen], []):
        assert ARM in run_make(f"BUILD={build}", "nucleo_f401re", *words).stdout
    programs = [build / "nucleo_f401re-policy.elf", build / "nucleo_f401re.elf"]
    assert programs[0].read_bytes() != programs[1].read_bytes()

    def compiles_again(*words: str) -> bool:
        copy = shutil.copytree(build, tmp_path / f"copy_{len([*tmp_path.iterdir()])}")
        return ARM in run_make("-n", f"BUILD={copy}", "nucleo_f401re", *words).stdout

    assert not compiles_again(chosen)
    assert not compiles_again()
    assert compiles_again(f"POLICY={other}")
    assert compiles_again(chosen, "POLE_LENGTH=0.3")
    os.utime(policy / "policy.h", (2**31, 2**31))
    assert compiles_again(chosen)
    assert not compiles_again()


@needs_arm
def test_any_notation_of_a_length_compiles(tmp_path: Path) -> None:
    for length in ("1", ".3"):
        done = run_make(f"BUILD={tmp_path}", "nucleo_f401re", f"POLICY={SHUTTLE}", f"POLE_LENGTH={length}")
        assert (done.returncode, done.stderr) == (0, "")
        assert ARM in done.stdout


@pytest.mark.parametrize("length", ["355.6", "0", "0,3556", "nan"])
def test_a_length_that_no_pole_has_is_refused(length: str) -> None:
    done = run_make("-n", "nucleo_f401re", f"POLICY={SHUTTLE}", f"POLE_LENGTH={length}")
    assert done.returncode != 0
    assert f"POLE_LENGTH={length}: give twice the distance from pivot to centre of mass in m" in done.stderr


@needs_arm
def test_a_folder_without_a_policy_is_named(tmp_path: Path) -> None:
    """make -C looks for a relative folder in firmware/."""
    folder = shutil.copytree(SHUTTLE, tmp_path / "policy").name
    done = run_make(f"BUILD={tmp_path}", "nucleo_f401re", f"POLICY={folder}", folder=tmp_path)
    assert done.returncode != 0
    assert f"POLICY={folder}: there is no policy.c in it; give the absolute path" in done.stderr


@needs_zig
@pytest.mark.parametrize(
    "target",
    [
        ("thumb-linux-musleabihf", "-mcpu=cortex_m4"),
        ("thumb-linux-musleabi", "-mcpu=cortex_m0plus"),
        ("riscv32-linux-musl", "-mcpu=generic_rv32+m+c"),
    ],
    ids=["Cortex-M4", "Cortex-M0+", "RISC-V 32 (ESP32-C3)"],
)
def test_the_core_compiles_for_a_processor(target: tuple[str, str], tmp_path: Path) -> None:
    """Files are compiled, not linked; musl only provides string.h and math.h."""
    folder = firmware_folder()
    for file in sorted(folder.glob("src/*.c")):
        command = [sys.executable, "-m", "ziglang", "cc", "-target", *target, *STRICT, "-Os", "-c", str(file)]
        done = subprocess.run([*command, "-o", str(tmp_path / "object.o")], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, ""), file.name
