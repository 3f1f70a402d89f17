"""docs/first-hour.md, followed to the letter with emulated carts that keep a real cart's time.

The port stands in for /dev/ttyUSB0; what takes minutes is short. Each command's last line is the next
command of the page.
"""

import re
import shlex
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import TINY
from page_commands import IDENTIFYING, ROOT, TUNING, block_lines, run_here

from cartpole_rl.evaluation.recordings import read_recording

PAGE = ROOT / "docs/first-hour.md"
TEXT = PAGE.read_text(encoding="utf-8")
PORT = "/dev/ttyUSB0"
SHORTER = {
    "cartpole-train": list(TINY),
    "cartpole-finetune": TUNING,
    "cartpole-identify": IDENTIFYING,
    "cartpole-evaluate run=runs": ["episodes=1"],
    "cartpole-record": ["episodes=1"],
}
UNTAUGHT = re.compile("cartpole-(?:emulate|find|train experiment)")


def printed_lines() -> list[str]:
    """The lines of the preflight on the page, numbers left out."""
    return [without_numbers(line.removesuffix("...")) for line in re.findall("^    (OK .*)$", TEXT, re.M)]


def without_numbers(text: str) -> str:
    return re.sub(r"[+-]?\d+(\.\d+)*", "0", text)


def without_laws(command: str) -> str:
    """Return a command without the friction laws, which the data decide."""
    return re.sub(r"_friction=\S+", "", command)


def minutes(sentence: str) -> float:
    """The number of minutes that a sentence of the page gives; words are numbers up to five."""
    found = re.search(sentence.replace("{}", r"(\w+)"), " ".join(TEXT.split()))
    assert found, sentence
    return {"a": 1, "two": 2, "three": 3, "four": 4, "five": 5}[found[1]]


@pytest.mark.nightly
def test_the_page_is_a_path(tmp_path: Path, serial_port: Callable[..., str]) -> None:
    """It takes ten minutes: an emulated cart with a real clock drives as long as a real one."""
    hanging = serial_port("emulator.clock=real")
    runs: dict[str, str] = {}
    took: dict[str, float] = {}
    following = ""
    commands = [line for line in block_lines(PAGE, "cartpole-") if not UNTAUGHT.match(line)]
    assert len(commands) == 11
    for command in commands:
        upright = "task=balance" in command
        line = re.sub(
            r"runs/(\w+)/<run>",
            lambda verb: f"runs/{verb[1]}/{runs[verb[1]]}",
            command.replace(PORT, hanging),
        )
        assert not following or without_laws(following) == without_laws(line), command
        line = following or line
        short = next((words for start, words in SHORTER.items() if line.startswith(start)), [])
        port = serial_port("emulator.clock=real", "emulator.start=upright") if upright else hanging
        started = time.monotonic()
        done = run_here(line.replace(hanging, port), *short, cwd=tmp_path)
        took[command] = time.monotonic() - started
        assert done.returncode == 0, f"{command}\n{done.stderr}"
        following = done.stdout.splitlines()[-1].replace(port, hanging)
        verb = shlex.split(command)[0].removeprefix("cartpole-")
        if verb == "preflight":
            lines = [without_numbers(each) for each in done.stdout.splitlines()[:8]]
            assert all(map(str.startswith, lines, printed_lines())), done.stdout
            assert took[command] < 90 * minutes("After about {} minute ")
        else:
            runs[verb] = max(path.name for path in (tmp_path / "runs" / verb).iterdir())
        if verb == "replay":  # which leads to docs/learned-model.md
            assert following == f"cartpole-model from=runs/record/{runs['record']}"
            following = ""
    experiments = (tmp_path / "runs/identify").glob("*/recordings/*.csv")
    motion = sum(read_recording(path).episode.steps for path in experiments) * 0.02 / 60
    assert motion < minutes("About {} minutes of motion") < motion + 2  # homing and rests included
    reported = (tmp_path / "runs/report" / runs["report"] / "runs.csv").read_text().splitlines()
    assert len(reported) == 1 + 4
