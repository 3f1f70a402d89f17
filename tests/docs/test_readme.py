"""The README says what is so; its commands that test_guides.py does not run do what they say."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import BIN, interrupt_after
from page_commands import BUDGET, README, ROOT, TUNING, block_lines, run_here

VERBS = (
    "train evaluate record replay identify model finetune distill emulate find-port preflight report export"
)
COMMANDS = block_lines(README, r"cartpole-|tensorboard|\./scripts/")


def listed(start: str) -> list[str]:
    return [command for command in COMMANDS if command.startswith(start)]


def test_the_readme_opens_with_the_two_commands() -> None:
    assert COMMANDS[:2] == ["./scripts/demo", "./scripts/test"]
    for command in COMMANDS[:3]:
        assert (ROOT / command.split()[0]).stat().st_mode & 0o100


def test_the_results_are_those_of_the_pages() -> None:
    pages = "".join((ROOT / "docs/results" / name).read_text() for name in ("learning.md", "fine-tuning.md"))
    table = [row for row in README.read_text().splitlines() if re.match(r"\|.*\| \d+ \| ", row)]
    assert len(table) == 7
    assert not {number for number in re.findall(r"\d\.\d{3}", "".join(table)) if number not in pages}


def test_the_installation_is_that_of_the_demo() -> None:
    (install,) = listed("./scripts/install")
    assert install.removeprefix("./") in (ROOT / "scripts/demo").read_text().splitlines()


def test_every_command_is_one_that_a_test_runs() -> None:
    known = {"./scripts/demo", "./scripts/test", "./scripts/install", "tensorboard"}
    known |= {f"cartpole-{verb}" for verb in VERBS.split()}
    assert {command.split()[0] for command in COMMANDS} == known


@pytest.mark.nightly
@pytest.mark.usefixtures("without_pictures")
def test_resume(trained: Path) -> None:
    """A training is interrupted, resumed, and interrupted again."""
    (command,) = [command for command in listed("cartpole-train") if "resume" in command]
    folder = trained / "runs/train/stopped"
    longer = ["learning.transitions=10000000", "learning.evaluations=5000", f"hydra.run.dir={folder}"]
    for words in (["cartpole-train", *BUDGET, *longer], [command.replace("<run>", "stopped")]):
        evaluations = num_evaluations(folder)
        interrupt_after(folder / "checkpoints/resume.pt")
        interrupted = run_here(" ".join(words), cwd=trained)
        assert interrupted.returncode == 130, interrupted.stderr
        assert num_evaluations(folder) > evaluations
    assert len(json.loads((folder / "provenance.json").read_text())["resumed"]) == 1


def num_evaluations(folder: Path) -> int:
    """The number of evaluations that a training has written."""
    history = folder / "history.jsonl"
    return len(history.read_text().splitlines()) if history.exists() else 0


def test_find_port_lists_the_ports(tmp_path: Path) -> None:
    (command,) = listed("cartpole-find-port")
    result = run_here(command, cwd=tmp_path)
    assert "USB serial port" in result.stdout + result.stderr


def test_emulate() -> None:
    (command,) = listed("cartpole-emulate")
    name, *words = command.split()
    with subprocess.Popen([BIN / name, *words], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = json.loads(process.stdout.readline())["port"]
        assert Path(port).exists()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=100) in (0, 130)


@pytest.mark.nightly
def test_tensorboard_reads_the_runs(trained: Path) -> None:
    (command,) = listed("tensorboard")
    name, *words = command.split()
    result = subprocess.run([BIN / name, *words, "--inspect"], cwd=trained, capture_output=True, text=True)
    assert "evaluation/score" in result.stdout, result.stderr


@pytest.mark.nightly
def test_the_demo_after_its_installation(tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, ROOT / "scripts/demo.py", *BUDGET, "--", *TUNING],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert "after fine-tuning" in result.stdout
    (comparison,) = tmp_path.glob("runs/demo/*/comparison.png")
    assert comparison.stat().st_size > 10_000
