"""Lines of text: what is read, what is sent, and which settings are refused."""

import math
import os
import pty
import select
import tty
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from pydantic import ValidationError

from cartpole_rl.choices import choice
from cartpole_rl.errors import LinkError
from cartpole_rl.plants.drivers.driver import Measurement
from cartpole_rl.plants.drivers.text import TextDriver
from cartpole_rl.plants.settings import DriverSettings, TextSettings
from cartpole_rl.rig.hardware import hardware_of

RIG = hardware_of(choice("cart/stepper"))  # 25 um, 4096 counts a turn


class Line:
    """A driver and the other end of its line."""

    def __init__(self, **given: Any) -> None:
        self.board, end = pty.openpty()
        tty.setraw(end)
        self.driver = TextDriver(
            TextSettings(kind="text", port=os.ttyname(end), full=255, **given), RIG.encoders
        )
        self.driver.open()
        os.close(end)

    def read(self, *lines: bytes, timeout: float = 0.0) -> Measurement | None:
        for line in lines:
            os.write(self.board, line)
        return self.driver.read(timeout or 5.0)

    def sent(self, lines: int) -> bytes:
        came = b""
        while came.count(b"\n") < lines:
            assert select.select([self.board], [], [], 60.0)[0], f"only {came!r} came"
            came += os.read(self.board, 100)
        return came

    def close(self) -> None:
        self.driver.close()
        os.close(self.board)


@pytest.fixture
def line() -> Iterator[Line]:
    with closing(Line()) as opened:
        yield opened


UNITS = {
    "counts": ({}, b"1000,-40,12\n", Measurement(-40, 12, 1000)),
    "two spaces and a carriage return": ({}, b" 1000, -40, 12\r\n", Measurement(-40, 12, 1000)),
    "mm, deg, ms": (
        {"cart_unit": "mm", "pole_unit": "deg", "time_unit": "ms"},
        b"7,-1.0,90\n",
        Measurement(-40, 1024, 7000),
    ),
    "m, rad, s": (
        {"cart_unit": "m", "pole_unit": "rad", "time_unit": "s"},
        f"1.5,0.001,{math.pi}\n".encode(),
        Measurement(40, 2048, 1_500_000),
    ),
    "decimal commas": (
        {"cart_unit": "mm", "pole_unit": "deg", "separator": ";"},
        b"7;-1,0;89,9999999\r\n",
        Measurement(-40, 1024, 7),
    ),
    "small numbers": (
        {"cart_unit": "m", "pole_unit": "rad"},
        b"1,-1.0E-3,+.0\n",
        Measurement(-40, 0, 1),
    ),
    "other columns": (
        {"columns": ["pole", "-", "cart"], "separator": ";"},
        b"5;nonsense;6\n",
        Measurement(6, 5, None),
    ),
}


@pytest.mark.parametrize(("given", "text", "measured"), UNITS.values(), ids=UNITS)
def test_it_reads_the_columns_in_their_units(
    given: dict[str, Any], text: bytes, measured: Measurement
) -> None:
    with closing(Line(**given)) as line:
        assert line.read(text) == measured


BAD = [
    b"",
    b"1,2",
    b"1,2,3,4",
    b"1,2,nan",
    b"1,inf,3",
    b"1,2,x",
    b"\xff,1,2",
    b"1,2,1e30",
    b"9" * 300,
    b"1_0,2,3",
    b"1,2_0,3",
    b"1,1e3,3",
    b"1,\x1c2,3",
]


def test_counts_with_decimals_name_the_unit(line: Line) -> None:
    assert line.read(b"1,0.00,3\n", b"4,5,6\n") == Measurement(5, 6, 4)
    assert line.driver.why_bad.endswith("cart has decimals, so it is not in counts: give plant.cart_unit")


@pytest.mark.parametrize(
    ("bad", "why"), [(b"1,2,5,3,5", "which has 5 values,"), (b"1,2,3\r" * 40, r"200 bytes without \n,")]
)
def test_a_line_of_another_form_says_what_it_has(bad: bytes, why: str, line: Line) -> None:
    assert line.read(bad, timeout=0.05) is None
    assert line.read(b"\n", b"4,5,6\n") == Measurement(5, 6, 4)
    assert line.driver.why_bad.endswith(f" {why} is not time,cart,pole")


@pytest.mark.parametrize("fraction", ["", ".5"])
def test_raw_counts_are_not_taken_for_degrees(fraction: str) -> None:
    """A column of a finer scale that never has decimals is in counts, however far it moves."""
    numbers = [f"{place},{2 * place},{977 + place}{fraction}\n".encode() for place in range(6)]
    with closing(Line(pole_unit="deg")) as line:
        for number in numbers[:4]:
            line.read(number)
        if fraction:
            assert line.read(*numbers[4:])
        else:
            with pytest.raises(LinkError, match=r"leave out plant\.pole_unit=deg, or send decimals"):
                line.read(*numbers[4:])


def test_a_time_with_decimals_names_the_unit(line: Line) -> None:
    assert line.read(b"1.5,2,3\n", b"4,5,6\n") == Measurement(5, 6, 4)
    assert line.driver.why_bad.endswith("time has decimals, which plant.time_unit=us has not")


@pytest.mark.parametrize("bad", BAD)
def test_a_damaged_line_is_counted_and_not_measured(bad: bytes, line: Line) -> None:
    assert line.read(bad + b"\n", b"4,5,6\n") == Measurement(5, 6, 4)
    assert line.driver.bad
    assert line.driver.why_bad.endswith("is not time,cart,pole")


def test_a_line_may_come_in_pieces(line: Line) -> None:
    assert line.read(b"10,2", timeout=0.01) is None
    assert line.read(b"0,30\n4") == Measurement(20, 30, 10)
    assert line.read(b"0,5,6\n") == Measurement(5, 6, 40)


def test_the_end_of_a_line_that_is_too_long_is_no_line(line: Line) -> None:
    assert line.read(b"9" * 205, timeout=0.05) is None
    assert line.read(b"9000,100,200\n", timeout=0.05) is None
    assert line.driver.bad == 1
    assert line.read(b"10,20,30\n") == Measurement(20, 30, 10)


def test_a_clock_of_32_bits_goes_on_when_it_wraps(line: Line) -> None:
    first, second = line.read(b"4294967290,0,0\n"), line.read(b"4,0,0\n")
    assert first is not None
    assert second is not None
    assert (second.us or 0) - (first.us or 0) == 10


def test_it_sends_lines(line: Line) -> None:
    line.driver.send(-12.4)  # the first line ends half a one, of a host that died
    line.driver.stop()
    assert line.sent(3) == b"\n-12\n0\n"
    with closing(Line(line="a={:.2f}", stop_line="stop", home_line="home", homing="board")) as other:
        other.driver.send(1.234)
        other.driver.stop()
        other.driver.home()
        assert other.sent(4) == b"\na=1.23\nstop\nhome\n"


def test_lines_that_wait_for_long_are_discarded_and_the_next_one_is_whole(
    line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = 40
    monkeypatch.setattr(type(line.driver._line), "out_waiting", property(lambda port: waiting))
    monkeypatch.setattr("cartpole_rl.plants.drivers.text.QUEUED", 60.0)
    line.driver.send(1)  # so many may wait for a moment
    assert line.sent(2) == b"\n1\n"  # discarding may drop what the system has not handed over yet
    monkeypatch.setattr("cartpole_rl.plants.drivers.text.QUEUED", -1.0)
    with pytest.raises(
        LinkError, match=r"takes lines more slowly than they are sent: .*now 115200, a higher"
    ):
        line.driver.send(2)
    waiting = 0
    line.driver.stop()
    assert line.sent(2) == b"\n0\n"


def test_the_line_after_one_that_was_sent_in_part_is_whole(
    line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_a_part(data: bytes) -> None:
        os.write(line.driver._line.fd, data[:2])
        raise OSError("write timeout")

    line.driver.send(1)
    with monkeypatch.context() as patched:
        patched.setattr(line.driver._line, "write", write_a_part)
        with pytest.raises(LinkError, match="takes no bytes any more"):
            line.driver.send(253)
    line.driver.stop()
    assert line.sent(4) == b"\n1\n25\n0\n"


def test_a_board_that_is_gone_is_a_lost_link(line: Line) -> None:
    os.close(line.board)
    try:
        with pytest.raises(LinkError, match="is the cart unplugged"):
            line.driver.read(5)
    finally:
        line.board = os.open(os.devnull, os.O_RDONLY)


REFUSED = {
    "full: 0": ({"full": 0}, "full is 0"),
    "no pole": ({"columns": ["time", "cart"]}, "name the column pole once"),
    "two times": ({"columns": ["time", "time", "cart", "pole"]}, "the column time once at most"),
    "no number": ({"line": "go"}, "one line with the command"),
    "two numbers": ({"line": "{} {}"}, "write it with one number"),
    "a second line": ({"line": "{}\n{}"}, "write it with one number"),
    "damping of a voltage": ({"damping": 1.0}, "damping is for sends=speed and sends=acceleration"),
    "speed of a voltage": ({"fastest": 0.3}, "fastest is for sends=speed and sends=acceleration"),
    "exponents": ({"line": "a={}"}, "it writes small commands as 1.5e-05"),
    "capital exponents": ({"line": "a={:.3G}"}, "it writes small commands as 1.5e-05"),
    "exponents always": ({"line": "{:.3e}"}, "it writes small commands as 1.5e-05"),
    "a part of a number": ({"line": "{.x}"}, "write it with one number"),
    "a place in a number": ({"line": "{[0]}"}, "write it with one number"),
    "too coarse": ({"full": 12, "sends": "acceleration"}, "line={:.0f} writes 0.0471, .* as 0: give more"),
    "two lines": ({"stop_line": "s\nx"}, "is not one line of text"),
    "a stepper at a stop": (
        {"full": 12, "sends": "acceleration", "line": "{:.3f}", "homing": "stops"},
        "a stepper loses steps at a stop",
    ),
    "a line to home by, by hand": ({"home_line": "home"}, "home_line is for homing=board"),
    "a home, by hand": ({"home_position": 0.1}, "home_position is for homing=board, not homing=hand"),
    "a unit without its column": (
        {"columns": ["cart", "pole"], "time_unit": "ms"},
        "time_unit is of the column time",
    ),
    "no line to home by": ({"homing": "board"}, "homing=board needs home_line"),
}


@pytest.mark.parametrize(("given", "why"), REFUSED.values(), ids=REFUSED)
def test_settings_that_cannot_be_are_refused(given: dict[str, Any], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        TextSettings(**{"kind": "text", "port": "auto", "full": 255, **given})


def test_what_a_board_lacks_is_said() -> None:
    board = TextSettings(kind="text", port="auto", full=255)
    assert len(board.lacks) == 3
    assert "nothing stops a moving cart" in board.lacks[1]
    assert len(TextSettings(kind="text", port="auto", full=255, watchdog=True).lacks) == 2
    assert len(TextSettings(kind="text", port="auto", full=255, columns=("cart", "pole")).lacks) == 4
    own = DriverSettings(kind="driver", port="x", full=1, driver="cartpole_rl.plants.drivers.text:TextDriver")
    assert own.driver.item is TextDriver
