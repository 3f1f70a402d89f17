"""Every command of the README and the guides composes, and nightly runs to its end.

Those that need a launcher, Optuna or Ray are run by scripts/sweeps and scripts/bench/two_machines.py.
"""

import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import BIN, COARSE, DISTILLATION, interrupt_after
from page_commands import (
    BUDGET,
    IDENTIFYING,
    MODELLING,
    NEED_EXTRAS,
    README,
    TUNING,
    block_lines,
    guide_commands,
    run_here,
    within,
)

from cartpole_rl.checking import validated
from cartpole_rl.cli import VERBS
from cartpole_rl.composition import compose
from cartpole_rl.evaluation.recordings import read_recording

BUDGETS = {  # of each command; what the page gives stays, except where it takes minutes
    "train": [*BUDGET, "seed=0", "agent.action_gap=0.7"],  # the last two narrow the sweeps
    "evaluate": ["episodes=1"],
    "finetune": TUNING,
    "identify": IDENTIFYING,
    "model": MODELLING,
    "distill": [*DISTILLATION],
    "report": ["animations=false"],
    "record": [],
    "replay": [],
    "export": [],
    "import": [],
    "preflight": [],
}
LONG = (
    "learning.transitions=",
    "episodes=40",
    "episodes=20",
    "finetuning.iterations=",
    "seed=range",
    "emulator.clock=real",
)
MAKERS = {  # the command that makes the first run of each kind, most of them from a page
    "identify": "cartpole-identify plant=emulated emulator.cogging=0.4",
    "model": "cartpole-model from=runs/identify/<run> pole_friction=bearing",
    "distill": "cartpole-distill run=runs/train/<run> hidden=[32,32]",
    "finetune": "cartpole-finetune run=runs/train/first episodes=3",  # interrupted, as a page resumes it
    "import": "cartpole-import from=logs/ layout=sensorsini_2022 cart=sensorsini",
    "record": "cartpole-record run=lqr episodes=2",
    "export": "cartpole-export format=mcap from=runs/record/<run>",
    "evaluate": "cartpole-evaluate run=runs/train/first episodes=18",  # a page repeats episode 17
}


def without_numbers(command: str) -> str:
    """Return `command` without the number of its episodes."""
    return re.sub(r" episodes=\d+", "", command)


def commands() -> dict[str, str]:
    """The page of each command, but for those that other tests run."""
    start = "cartpole-(?!emulate|find-port|train resume)"
    known: set[str] = set()
    found: dict[str, str] = {}
    for page, line in [*(("README.md", line) for line in block_lines(README, start)), *guide_commands(start)]:
        if page in ("docs/first-hour.md", "docs/my-cart.md"):
            continue
        if without_numbers(line) not in known and not any(extra in line for extra in NEED_EXTRAS):
            found.setdefault(line, page)
            known.add(without_numbers(line))
    return found


COMMANDS = commands()


@pytest.fixture
def made(trained: Path) -> Callable[[str], None]:
    """Make runs/<kind>/first unless it is there, and what it is made from."""

    def make(kind: str) -> None:
        folder = trained / f"runs/{kind}/first"
        if folder.exists() and (kind != "export" or any(folder.rglob("*.mcap"))):
            return
        shutil.rmtree(folder, ignore_errors=True)  # an export of another page
        if kind == "import":
            make("identify")
            lay_out_logs(trained)
        command = MAKERS[kind].replace("<run>", "first")
        need(command, make)
        more = [*within(BUDGETS[kind], command), *coarse(command), f"hydra.run.dir=runs/{kind}/first"]
        if kind == "finetune":
            interrupt_after(trained / "runs/finetune/first/recordings/tune_000.csv")
        done = run_here(command, *more, cwd=trained)
        assert done.returncode == (130 if kind == "finetune" else 0), done.stderr
        assert done.stdout or kind == "finetune"

    return make


def need(command: str, make: Callable[[str], None]) -> None:
    """Make the runs that `command` reads."""
    for kind in re.findall(r"runs/(\w+)(?:/first|(?= 'format))", command):
        make(kind)


def coarse(command: str) -> list[str]:
    """Return the setting for a fast emulated cart where `command` drives one."""
    drives_one = "plant=emulated" in command or command.startswith("cartpole-finetune run")
    return [COARSE] if drives_one and "plant=serial" not in command else []


def lay_out_reports(folder: Path) -> None:
    """Make the sweeps that the pages name: copies of one run."""
    for name in ("2026-11-21_12-00-00_multirun", "a", "b", "first_multirun", "second_multirun"):
        target = folder / "runs/train" / name / ("0_seed-0" if name.endswith("multirun") else ".")
        if not target.exists():
            shutil.copytree(folder / "runs/train/first", target)


def lay_out_logs(folder: Path) -> None:
    """Write the recordings of the identification as logs of another cart."""
    (folder / "logs").mkdir()
    for path in (folder / "runs/identify/first/recordings").glob("*.csv"):
        episode = read_recording(path).episode
        motor = np.concatenate(([0], episode.motor)) * -4706 / 255
        angle = (3344 - 4271 * episode.theta / (2 * np.pi)) % 4271
        rows = zip(-episode.x / 8.498e-5, angle, motor, strict=True)
        lines = (f"20,{x:.0f},{theta:.0f},{value:.0f},0,0" for x, theta, value in rows)
        head = "deltaTimeMs,position_raw,angle_raw,actualMotorSave,invalid_steps,frozen"
        (folder / "logs" / path.name).write_text("\n".join([head, *lines]))


def test_the_pages_have_commands() -> None:
    assert len(COMMANDS) > 50


def test_the_settings_of_every_command_compose() -> None:
    """Those of the README too; nightly tests run them."""
    for command in [*COMMANDS, *block_lines(README, "cartpole-")]:
        program, *words = shlex.split(re.sub("<.*?>", "first", command))
        verb = program.removeprefix("cartpole-").replace("-", "_")
        swept = "-m" in words or any(word.startswith("sweep=") for word in words)
        if verb == "find_port" or swept or any(word.endswith(".yaml") for word in words):
            continue  # several jobs, or files of other runs
        validated(VERBS[verb].find(VERBS[verb].settings), compose(verb, words))


@pytest.mark.nightly
@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_runs(
    command: str, trained: Path, made: Callable[[str], None], serial_port: Callable[..., str]
) -> None:
    verb = command.split()[0].removeprefix("cartpole-")
    if command == MAKERS.get(verb):
        made(verb)
        return
    words = [word for word in shlex.split(command) if not word.startswith(LONG)]
    line = shlex.join(words).replace("<run>", "first").replace("RUN", "runs/train/first")
    line = re.sub(r"runs/reproduce/full/\S*/10", "runs/train/first", line)
    need(line, made)
    if verb == "report":
        lay_out_reports(trained)
    if "plant=serial" in line:
        board = ["emulator.start=upright"] if "task=balance" in line else []  # a hand holds the pole
        if "plant.policy=onboard" in line:
            run_here("cartpole-export run=runs/train/first format=c hydra.run.dir=onboard", cwd=trained)
            board = ["emulator.firmware=c", f"emulator.policy={trained / 'onboard'}"]
        line = re.sub(r"/dev/\S+", serial_port(*board), line)
    folder = f"runs/guides/{abs(hash(command))}"
    where = [f"hydra.{'sweep' if ' -m ' in line or 'sweep=' in line else 'run'}.dir={folder}"]
    where *= "resume=" not in line and "hydra.run.dir" not in line
    budget = [] if "resume=" in line or "repeat." in line else within(BUDGETS[verb], line)
    done = run_here(line, *budget, *coarse(line), *where, cwd=trained)
    assert done.returncode == 0, f"{COMMANDS[command]}: {command}\n{done.stderr}"
    assert done.stdout


@pytest.mark.nightly
@pytest.mark.parametrize(("page", "command"), guide_commands("cartpole-emulate"))
def test_the_emulated_cart_starts(page: str, command: str, tmp_path: Path) -> None:
    name, *words = shlex.split(command)
    with subprocess.Popen([BIN / name, *words], cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert '"port"' in process.stdout.readline(), page
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=100) in (0, 130)
