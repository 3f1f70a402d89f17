"""docs/my-cart.md, followed to the letter: its files, its commands, its driver."""

import json
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread

import pytest
import yaml
from command_line import COARSE
from page_commands import BUDGET, IDENTIFYING, ROOT, TUNING, block_lines, run_here, within

PAGE = ROOT / "docs/my-cart.md"
TEXT = PAGE.read_text(encoding="utf-8")
COMMANDS = block_lines(PAGE, "cartpole-")
BUDGETS = {"train": [*BUDGET, "seed=0"], "identify": IDENTIFYING, "finetune": TUNING}
BOARD = ROOT / "tests/support/text_board.py"
ENDED = 1  # the status of a preflight that is not ready


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a person who has written the files of the page."""
    folder = tmp_path_factory.mktemp("mine")
    for name in ("mine.yaml", "my_pole.yaml", "my_emulator.yaml", "board.yaml"):
        block = re.search(rf"`{name}`.*?\n\n((?:    [^\n]*\n)+)", TEXT, re.S)
        assert block
        (folder / name).write_text(re.sub(r"^    ", "", block[1], flags=re.M))
        assert yaml.safe_load((folder / name).read_text())
    return folder


def test_the_commands_are_those_of_the_page() -> None:
    verbs = [command.split()[0].removeprefix("cartpole-") for command in COMMANDS]
    assert verbs == ["preflight", "identify", "train", "evaluate", "finetune", "evaluate", "preflight"]


@pytest.mark.nightly
def test_the_emulated_cart_is_followed_to_the_end(folder: Path) -> None:
    for command in COMMANDS[:6]:
        verb = command.split()[0].removeprefix("cartpole-")
        line = command.replace("<run>", "runs/train/mine")
        more = within(BUDGETS.get(verb, []), line)
        more += [COARSE] if "plant=emulated" in line else []
        more += ["hydra.run.dir=runs/train/mine"] if verb == "train" else []
        done = run_here(line, *more, cwd=folder)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"


@pytest.mark.nightly
def test_a_board_that_speaks_text_passes_the_preflight(folder: Path) -> None:
    """The stepper of tests/support, whose lines and command the settings of the page describe."""
    with subprocess.Popen([sys.executable, BOARD], stdout=subprocess.PIPE, text=True) as board:
        assert board.stdout is not None
        port = board.stdout.readline().strip()
        stepper = {"sends": "acceleration", "full": 12, "damping": 2, "line": "a={:.3f}", "port": port}
        lines = {"separator": ",", "time_unit": "us", "cart_unit": "counts", "pole_unit": "counts"}
        of_page = yaml.safe_load((folder / "board.yaml").read_text())
        mine = of_page | stepper | lines | {"homing": "board", "home_line": "home"}
        (folder / "board.yaml").write_text(yaml.safe_dump(mine))
        done = run_here(COMMANDS[-1].replace("mine.yaml", "stepper"), cwd=folder)
        board.kill()
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("OK ") == 8


@contextmanager
def udp_cart() -> Iterator[tuple[int, list[str]]]:
    """A cart that stands in its middle, and speaks UDP to whoever has told it a motor value."""
    told: list[str] = []
    ended = Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as cart:
        cart.bind(("127.0.0.1", 0))
        begun = time.monotonic()

        def serve() -> None:
            host, ticks = None, 0
            while not ended.is_set():
                cart.settimeout(max(1e-4, begun + 0.01 * ticks - time.monotonic()))
                try:
                    text, host = cart.recvfrom(100)
                    told.append(text.decode())
                except TimeoutError:
                    ticks += 1
                    if host is not None:
                        cart.sendto(f"{10_000 * ticks} 5 7".encode(), host)

        thread = Thread(target=serve, daemon=True)
        thread.start()
        yield cart.getsockname()[1], told
        ended.set()
        thread.join()


@pytest.mark.nightly
def test_the_driver_of_the_page_reads_and_stops_its_cart(folder: Path) -> None:
    block = re.search(r"^```python\n# my_cart\.py\n(.*?)^```$", TEXT, re.M | re.S)
    assert block
    (folder / "my_cart.py").write_text(block[1])
    with udp_cart() as (port, told):
        words = f"cart=laboratorio plant=driver plant.driver=my_cart:MyCart plant.port=localhost:{port}"
        command = f"cartpole-preflight {words} plant.full=255 plant.homing=stops"
        done = run_here(command, cwd=folder)
        deadline = time.monotonic() + 30
        while told[-1] != "0":
            assert time.monotonic() < deadline
    assert done.returncode == ENDED, done.stdout + done.stderr
    assert "OK   link" in done.stdout  # it answers; it does not move, so homing fails
    assert json.loads(f"[{','.join(told)}]").count(0) > 3
