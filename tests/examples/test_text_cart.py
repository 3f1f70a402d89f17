"""The Arduino sketch of a cart that speaks lines of text, compiled with a stand-in for the Arduino core."""

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SKETCH = ROOT / "examples/text_cart/text_cart.ino"
RIGHT, LEFT = 18, 19


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if (compiler := shutil.which("g++")) is None:
        pytest.skip("needs g++")
    target = tmp_path_factory.mktemp("sketch") / "text_cart"
    core = ROOT / "tests/support/arduino"
    words = ["-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{core}", "-x", "c++", SKETCH, "-o", target]
    subprocess.run([compiler, *words], check=True)
    return target


@pytest.fixture
def board(program: Path) -> Iterator["subprocess.Popen[str]"]:
    pipe = subprocess.PIPE
    with subprocess.Popen([program], stdin=pipe, stdout=pipe, stderr=pipe, text=True, bufsize=1) as process:
        yield process
        process.kill()


def said(board: "subprocess.Popen[str]") -> tuple[int, int]:
    """Return the next PWM pin and value."""
    assert board.stderr is not None
    pin, value = board.stderr.readline().split()
    return int(pin), int(value)


def tell(board: "subprocess.Popen[str]", text: str) -> None:
    assert board.stdin is not None
    board.stdin.write(text)
    board.stdin.flush()


def test_it_sends_its_time_and_two_counts(board: "subprocess.Popen[str]") -> None:
    assert board.stdout is not None
    lines = [[int(word) for word in board.stdout.readline().split(",")] for _ in range(20)]
    assert all(counts == [0, 0] for _, *counts in lines)
    assert lines[-1][0] - lines[0][0] > 150_000


def test_it_drives_both_ways_and_stops_when_nobody_speaks(board: "subprocess.Popen[str]") -> None:
    tell(board, "120\n")
    assert said(board) == (RIGHT, 120)
    tell(board, "-80\r\n")
    assert [said(board), said(board)] == [(RIGHT, 0), (LEFT, 80)]
    assert said(board) == (LEFT, 0)  # the watchdog


def test_half_a_line_before_a_silence_is_no_motor_value(board: "subprocess.Popen[str]") -> None:
    tell(board, "7\n25")
    assert [said(board), said(board)] == [(RIGHT, 7), (RIGHT, 0)]  # the watchdog
    time.sleep(0.01)  # a byte may be a millisecond younger than the line before it
    tell(board, "5\n9\n")
    assert said(board) == (RIGHT, 9)


def test_bytes_without_end_do_not_stop_the_watchdog_and_measurements(program: Path, tmp_path: Path) -> None:
    endless, pipe = tmp_path / "endless", subprocess.PIPE
    endless.write_bytes(b"200\n")
    os.truncate(endless, 1 << 30)
    with (
        endless.open() as bytes_,
        subprocess.Popen([program], stdin=bytes_, stdout=pipe, stderr=pipe, text=True) as board,
    ):
        assert [said(board), said(board)] == [(RIGHT, 200), (RIGHT, 0)]
        assert board.stdout is not None
        assert [board.stdout.readline() for _ in range(20)][-1]
        board.kill()


@pytest.mark.parametrize("bad", ["300", "12x", "", " ", "\r", "25\0x", "nan", "1" * 40, "--5"])
def test_it_ignores_what_is_no_motor_value(bad: str, board: "subprocess.Popen[str]") -> None:
    tell(board, f"{bad}\n7\n")
    assert said(board) == (RIGHT, 7)
