"""A cart with firmware of its own, driven by lines of text: a program of its own.

Tests that drive in real time, 10 ms a period, are nightly: they need a machine that has time for them.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import pytest
from command_line import console_script, outcome

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError, EmulatorError, LinkError, PlantError
from cartpole_rl.plants.emulated import BridgeProcess
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.plant import SerialPlant, cart_on_port
from cartpole_rl.plants.serial.preflight import preflight
from cartpole_rl.plants.serial.preparation import Confirm, always, nobody
from cartpole_rl.plants.settings import DriverSettings, TextSettings
from cartpole_rl.rig.hardware import hardware_of

BOARD = Path(__file__).parents[2] / "support" / "text_board.py"
CART = choice("cart/stepper")
RIG = hardware_of(CART)
STEPPER: dict[str, Any] = {
    "kind": "text",
    "sends": "acceleration",
    "full": 12.0,
    "damping": 2.0,
    "line": "a={:.3f}",
}


@contextmanager
def board(**options: Any) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A running board: its port and process."""
    process = subprocess.Popen([sys.executable, str(BOARD), json.dumps(options)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().decode().strip(), process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def driven(port: str, period: float = 0.01, confirm: Confirm = always, **changed: Any) -> SerialPlant:
    settings = TextSettings(**STEPPER | {"port": port} | changed)
    return cart_on_port(settings, EmulatorSettings(), period, "hanging", print, confirm, RIG.model_dump())


@contextmanager
def driven_board(
    journal: Path | str = os.devnull, period: float = 0.01, **changed: Any
) -> Iterator[SerialPlant]:
    """A running board, and the plant on it. The options of the board are `board`."""
    options = {"journal": str(journal), **changed.pop("board", {})}
    with board(**options) as (port, _), closing(driven(port, period, **changed)) as plant:
        yield plant


def taken(journal: Path) -> list[tuple[float, str, float]]:
    """What the board took: time in s, line, speed of the cart then in m/s."""
    lines = [line.split(" ") for line in journal.read_text().splitlines()]
    return [(float(line[0]), line[1], float(line[-1].removeprefix("v="))) for line in lines]


def last_speed(journal: Path) -> float:
    """The speed at which the cart was left, once the board has taken the last line."""
    before = -1
    while len(now := taken(journal)) != before:
        before = len(now)
        time.sleep(0.1)
    return now[-1][2]


@pytest.mark.nightly
def test_it_is_driven_and_left_standing(tmp_path: Path) -> None:
    with driven_board(tmp_path / "journal") as plant:
        assert plant.reset_one().counts == (0, 2048)
        speed = place = 0.0
        for _ in range(30):
            frame = plant.step_one(60)  # 2.8 m/s^2 and damping, unless this computer is late
            (dt,) = frame.dt
            speed += (12 * plant.drove(60) / 255 - 2 * speed) * dt
            place += speed * dt
        cart, pole = frame.counts
        assert cart * 25e-6 == pytest.approx(place, abs=0.03)
        assert pole > 2048  # its tip stays behind
        assert not frame.ends
        assert dt == pytest.approx(0.01 * round(dt / 0.01), abs=1e-4)
        plant.close()
        lines = taken(tmp_path / "journal")
        assert any(line == "a=2.824" for _, line, _ in lines)
        assert abs(last_speed(tmp_path / "journal")) < 0.001  # the acceleration 0 alone would let it roll


@pytest.mark.nightly
def test_the_end_of_the_track_is_not_touched(tmp_path: Path) -> None:
    with driven_board(tmp_path / "journal") as plant:
        plant.reset_one()
        for _ in range(300):
            if plant.step_one(-255).ends:
                break
        assert plant.ended_by == "track"
        plant.reset_one()
        assert abs(plant.cart.poll_state().cart_counts) < 100
        positions = re.findall(r"x=(\S+)", (tmp_path / "journal").read_text())
        assert max(abs(float(x)) for x in positions) < 0.3


@pytest.mark.nightly
def test_a_board_that_homes_by_itself(tmp_path: Path) -> None:
    with driven_board(tmp_path / "journal", homing="board", home_line="home") as plant:
        assert plant.reset_one().counts == (0, 2048)
        lines = [line for _, line, _ in taken(tmp_path / "journal")]
        assert lines[0] == ""  # which ends half a line of another host
        assert lines[1] in ("home", "a=-0.000", "a=0.000")
        assert lines.count("home") == 1


@pytest.mark.nightly
def test_reversed_signs() -> None:
    """The same motion, as seen from the other side."""
    with driven_board(cart_reversed=True, pole_reversed=True, full=-12.0) as plant:
        plant.reset_one()
        for _ in range(20):
            frame = plant.step_one(60)
        assert frame.counts[0] > 0
        assert frame.counts[1] > 2048


@pytest.mark.nightly
def test_every_second_line_is_a_period() -> None:
    with driven_board(period=0.02) as plant:
        plant.reset_one()
        assert plant.step_one(0).dt == pytest.approx((0.02,), abs=1e-4)


def test_an_impossible_period_is_refused_before_anything_moves(tmp_path: Path) -> None:
    with board(journal=str(tmp_path / "journal")) as (port, _):
        with pytest.raises(ConfigError, match=r"measures every 10 ms; give control_period=0.01 or 0.02"):
            driven(port, 0.014)
        assert {line for _, line, _ in taken(tmp_path / "journal")} == {"", "a=0.000"}


def test_a_cart_that_is_put_in_place_by_hand_needs_a_person() -> None:
    words = r"plant\.homing=hand: a person has to put the cart in the middle"
    with driven_board(confirm=nobody) as plant, pytest.raises(PlantError, match=words):
        plant.reset_one()


@pytest.mark.nightly
def test_damaged_lines_are_dropped() -> None:
    """A tenth of all lines: nothing jumps, nothing ends."""
    with driven_board(board={"garbage": 0.1}) as plant:
        plant.reset_one()
        counts = [plant.step_one(40 if period % 40 < 20 else -40).counts[0] for period in range(120)]
        assert not plant.ended_by
        assert max(abs(after - before) for before, after in pairwise(counts)) < 1500


NOTHING_WHOLE = "(most of what|no measurement) (comes|came) from"
FAILURES = {
    "death": ({}, "is the cart unplugged|no measurement"),
    "silence": ({"silent": True}, "no measurement came from .* for"),
    "noise": (
        {"noise": True},
        NOTHING_WHOLE + ".* compare the settings of plant=text",
    ),
    "frozen time": ({"freeze": "time"}, NOTHING_WHOLE + ".* its time stands still at"),
}


@pytest.mark.nightly
@pytest.mark.parametrize(("options", "why"), FAILURES.values(), ids=FAILURES)
def test_a_board_that_fails_is_stopped(options: dict[str, Any], why: str, tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    with board(journal=str(journal), at=5, **options) as (port, process), closing(driven(port)) as plant:
        plant.reset_one()
        deadline = time.monotonic() + 20
        for period in count():
            if (frame := plant.step_one(20 if period % 40 < 20 else -20)).ends:
                break
            if not options:
                process.kill()
            assert time.monotonic() < deadline
        assert frame.truncated[0]
        assert plant.ended_by == "link"
        with pytest.raises(LinkError, match=why):
            plant.reset_one()
        if options:
            assert abs(last_speed(journal)) < 0.02  # by what was sent: no measurement tells
            assert float(taken(journal)[-1][1].removeprefix("a=")) == 0


def test_preflight_names_lost_lines_where_periods_are_long() -> None:
    with (
        board(garbage=0.15) as (port, _),
        TextSettings(**STEPPER, port=port).reachable(EmulatorSettings(), RIG) as (settings, server),
        closing(SerialCart(settings, RIG, server=server)) as cart,
    ):
        assert "on plant=text, lines may be lost or damaged" in [*preflight(cart)][-1].words


def test_preflight_says_why_a_board_is_lost(caplog: pytest.LogCaptureFixture) -> None:
    """Not that an internal port cannot be read, nor that a stopped motor may still be on."""
    words = ""
    with (
        suppress(EmulatorError),  # of the bridge that has ended
        board() as (port, process),
        TextSettings(**STEPPER, port=port).reachable(EmulatorSettings(), RIG) as (settings, server),
        closing(SerialCart(settings, RIG, server=server)) as cart,
    ):
        process.send_signal(signal.SIGSTOP)  # not by its own clock: the bridge may be slow to start
        words = [*preflight(cart)][-1].words
    assert words.startswith(f"no measurement came from {port} for")
    assert "may still be on" not in caplog.text


@pytest.mark.nightly
def test_a_frozen_counter_latches_a_fault(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    with driven_board(journal, board={"at": 4, "freeze": "both"}) as plant:
        plant.reset_one()
        for period in range(1500):
            if (frame := plant.step_one(70 if period % 60 < 30 else -70)).ends:
                break
        assert frame.truncated[0]
        assert plant.ended_by == "fault"
        assert abs(last_speed(journal)) < 0.1
        assert float(taken(journal)[-1][1].removeprefix("a=")) == 0


def test_a_bridge_that_is_killed_says_that_the_motor_may_be_on() -> None:
    with board() as (port, _):
        bridge = BridgeProcess(TextSettings(**STEPPER, port=port), RIG, None)
        os.kill(bridge.pid, signal.SIGKILL)
        assert "exit code -9" in bridge.death()
        assert bridge.died.endswith("the cart's motor may still be on: switch it off")
        with pytest.raises(LinkError, match="exit code -9"):  # not that its port is gone
            SerialPlant(TextSettings(**STEPPER, port=port).over(bridge.port), owned=bridge, hardware=RIG)


OWN_DRIVER = """
import time
from cartpole_rl.plants.drivers.driver import Driver, Measurement

class Talker(Driver):
    def open(self):
        self.read_so_far = 0
    def read(self, timeout):
        print("." * 10_000)  # in all, more than a pipe holds
        time.sleep(0.01)
        self.read_so_far += 1
        return Measurement(0, self.read_so_far % 2, 10_000 * self.read_so_far)
    def send(self, value):
        pass
    def close(self):
        pass

class Stuck(Talker):
    def close(self):
        time.sleep(1000)
"""


@pytest.mark.parametrize(("name", "warned"), [("Talker", False), ("Stuck", True)])
def test_a_driver_may_print_and_one_that_hangs_at_the_end_is_told(
    name: str,
    warned: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    (tmp_path / "own_driver.py").write_text(OWN_DRIVER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setattr("cartpole_rl.plants.emulated.GRACE", 0.5 if warned else 30.0)
    settings = DriverSettings(kind="driver", port="x", full=255, driver=f"own_driver:{name}")
    with BridgeProcess(settings, RIG, None):
        pass
    assert ("the cart's motor may still be on: switch it off" in caplog.text) == warned


@pytest.mark.nightly
def test_a_command_that_is_killed_leaves_the_cart_standing(tmp_path: Path) -> None:
    """The bridge stops the cart by its watchdog, and then ends."""
    journal = tmp_path / "journal"
    with board(journal=str(journal)) as (port, _):
        program = (
            "import sys; sys.path[:0] = sys.argv[2:]\n"
            "from test_bridge import driven\n"
            "plant = driven(sys.argv[1]); plant.reset_one(); print('driving', flush=True)\n"
            "while True: plant.step_one(30)\n"
        )
        command = [sys.executable, "-c", program, port, str(Path(__file__).parent), str(BOARD.parent)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            while process.stdout.readline().strip() != b"driving":
                assert process.poll() is None
            os.kill(process.pid, signal.SIGKILL)
        assert abs(last_speed(journal)) < 0.02
        with closing(driven(port)) as plant:  # the port was given back
            plant.reset_one()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("number", "during", "said"),
    [(signal.SIGINT, "home", "interrupted"), (signal.SIGTERM, r"a=-?0\.\d*[1-9]\d*", "terminated")],
    ids=["Ctrl-C while it homes", "SIGTERM while it moves"],
)
def test_a_signal_leaves_the_cart_standing_and_the_port_free(
    number: signal.Signals, during: str, said: str, tmp_path: Path
) -> None:
    journal = tmp_path / "journal"
    journal.touch()
    with board(journal=str(journal)) as (port, _):
        given = {**STEPPER, "line": '"a={:.3f}"', "port": port, "homing": "board", "home_line": "home"}
        words = [f"plant.{name}={value}" for name, value in given.items() if name != "kind"]
        process = console_script("preflight", "plant=text", "cart=stepper", *words, folder=tmp_path)
        while not any(re.fullmatch(during, line) for _, line, _ in taken(journal)):
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(number)
        done = outcome(process)
        assert (done.code, done.err.splitlines()[-1]) == (128 + number, f"cartpole-preflight: {said}")
        assert abs(last_speed(journal)) < 0.02
        assert taken(journal)[-1][1] in ("a=0.000", "a=-0.000")
        driven(port).close()
