"""Every command of the README does what it says, with budgets that take seconds.

One training, the emulator, TensorBoard and the demo run in processes of their own. The rest runs in this one,
because PyTorch takes seconds to import.
"""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import BIN, COARSE, DISTILLATION, interrupt_after
from page_commands import (
    BUDGET,
    IDENTIFYING,
    MODELLING,
    README,
    ROOT,
    TUNING,
    block_lines,
    run_here,
    within,
)

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


def test_every_command_is_one_that_a_test_here_runs() -> None:
    known = {"./scripts/demo", "./scripts/test", "./scripts/install", "tensorboard"}
    known |= {f"cartpole-{verb}" for verb in VERBS.split()}
    assert {command.split()[0] for command in COMMANDS} == known


@pytest.mark.nightly
@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    "command",
    [command for command in listed("cartpole-train") if "<run>" not in command],
)
def test_train(command: str, tmp_path: Path) -> None:
    budget = within(BUDGET, command)
    if "learning.transitions=" in command:
        command = re.sub(r"learning.transitions=\d+", "learning.transitions=1024", command)
    result = run_here(command, *budget, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    runs = list(tmp_path.glob("runs/train/**/metrics.json"))
    assert len(runs) == (6 if " -m " in command else 1)


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


@pytest.mark.nightly
@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("command", listed("cartpole-evaluate"))
def test_evaluate(command: str, trained: Path, serial_port: Callable[[], str]) -> None:
    command = command.replace("<run>", "first").replace("/dev/ttyUSB0", "PORT")
    if "PORT" in command:
        command = command.replace("PORT", serial_port())
    elif "plant=emulated" in command:
        command = f"{command} {COARSE}"
    folder = f"runs/evaluate/{abs(hash(command))}"
    more = [] if "episodes" in command else ["episodes=1"]
    result = run_here(command, f"hydra.run.dir={folder}", *more, cwd=trained)
    assert result.returncode == 0, result.stderr
    metrics = json.loads((trained / folder / "metrics.json").read_text())
    assert metrics["plant"] in ("simulated", "emulated", "serial")
    assert len(metrics["episodes"]) == (20 if "episodes=20" in command else 1)


@pytest.mark.nightly
def test_identify_train_on_it_and_model_it(trained: Path, serial_port: Callable[[], str]) -> None:
    (identify,) = listed("cartpole-identify")
    identify = identify.replace("/dev/ttyUSB0", serial_port())
    identified = run_here(identify, *IDENTIFYING, "hydra.run.dir=runs/identify/mine", cwd=trained)
    assert identified.returncode == 0, identified.stderr
    (train,) = [command for command in listed("cartpole-train") if "identify" in command]
    result = run_here(train.replace("<run>", "mine"), *BUDGET, cwd=trained)
    assert result.returncode == 0, result.stderr
    (model,) = listed("cartpole-model")
    short = [*MODELLING, "hydra.run.dir=runs/model/mine"]
    modelled = run_here(model.replace("<run>", "mine"), *short, cwd=trained)
    assert modelled.returncode == 0, modelled.stderr
    assert (trained / "runs/model/mine/model.pt").exists()
    (learned,) = [command for command in listed("cartpole-train") if "plant=learned" in command]
    result = run_here(learned.replace("<run>", "mine"), *BUDGET, cwd=trained)
    assert result.returncode == 0, result.stderr


@pytest.mark.nightly
@pytest.mark.usefixtures("without_pictures")
def test_record_and_replay(trained: Path) -> None:
    (record,), (replay,) = listed("cartpole-record"), listed("cartpole-replay")
    recorded = run_here(
        record.replace("<run>", "first"), COARSE, "hydra.run.dir=runs/record/first", cwd=trained
    )
    assert recorded.returncode == 0, recorded.stderr
    replayed = run_here(replay.replace("<run>", "first"), "hydra.run.dir=runs/replay/first", cwd=trained)
    assert replayed.returncode == 0, replayed.stderr
    assert (trained / "runs/replay/first/replay.json").exists()


@pytest.mark.nightly
@pytest.mark.parametrize("command", listed("cartpole-finetune"))
def test_finetune(command: str, trained: Path, serial_port: Callable[[], str]) -> None:
    command = command.replace("<run>", "first").replace("episodes=20", "")
    if "/dev/ttyUSB0" in command:
        command = command.replace("/dev/ttyUSB0", serial_port())
    else:
        command = f"{command} {COARSE}"
    folder = f"runs/finetune/{abs(hash(command))}"
    result = run_here(command, *TUNING, f"hydra.run.dir={folder}", cwd=trained)
    assert result.returncode == 0, result.stderr
    assert (trained / folder / "checkpoints/last.pt").exists()


@pytest.mark.nightly
def test_distill(trained: Path) -> None:
    (command,) = listed("cartpole-distill")
    folder = "hydra.run.dir=runs/distill/readme"
    result = run_here(command.replace("<run>", "first"), *DISTILLATION, folder, cwd=trained)
    assert result.returncode == 0, result.stderr
    assert (trained / "runs/distill/readme/checkpoints/last.pt").exists()


@pytest.mark.nightly
@pytest.mark.parametrize("command", [*listed("cartpole-report"), *listed("cartpole-export")])
def test_pages(command: str, trained: Path) -> None:
    verb = command.split()[0].removeprefix("cartpole-")
    folder = f"runs/{verb}/first"
    result = run_here(command.replace("<run>", "first"), f"hydra.run.dir={folder}", cwd=trained)
    assert result.returncode == 0, result.stderr
    (page,) = (trained / folder).glob("*.html")
    assert "<html" in page.read_text(encoding="utf-8")


def test_find_port_lists_the_ports(tmp_path: Path) -> None:
    (command,) = listed("cartpole-find-port")
    result = run_here(command, cwd=tmp_path)
    assert "USB serial port" in result.stdout + result.stderr


@pytest.mark.nightly
def test_preflight(tmp_path: Path, serial_port: Callable[[], str]) -> None:
    (command,) = listed("cartpole-preflight")
    result = run_here(command.replace("/dev/ttyUSB0", serial_port()), "plant.write_timeout=2", cwd=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr


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
