"""Runs the commands as a user does, in this process (torch takes long to import) or in one of their own."""

import contextlib
import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from hydra.core.global_hydra import GlobalHydra

from cartpole_rl.cli import VERBS
from cartpole_rl.command import run_command
from cartpole_rl.reporting import style

BIN = Path(sys.executable).parent
TINY = (
    "learning.transitions=2048",
    "learning.carts=32",
    "learning.chunk=8",
    "learning.updates=2",
    "learning.batch_size=32",
    "learning.warmup_transitions=256",
    "learning.evaluations=2",
    "learning.evaluation_episodes=2",
    "learning.checkpoint_interval=1",
    "buffer.size=1500",
    "task.time_limit=60",
    "compile=false",
)
COARSE = "emulator.physics_step=1e-3"  # s; the default is half of it
FINETUNING = (
    "plant=emulated",
    COARSE,
    "episodes=2",
    "evaluation_episodes=1",
    "finetuning.iterations=2",
    "finetuning.refit=1",
    "compile=false",
)
TRUTH = ("emulator.cart_viscous=1.1", "emulator.latency=0.012", "emulator.angle_offset=-0.01")
QUICK = ("windows=40", "substeps=4", "carts=200")
IDENTIFICATION = (*TRUTH, COARSE, *QUICK)
ENSEMBLE = (
    "windows=20",
    "ensemble.members=2",
    "ensemble.hidden=4",
    "ensemble.updates=1",
    "ensemble.refresh=1",
)
DISTILLATION = tuple(
    f"distillation.{name}={value}"
    for name, value in {"carts": 8, "rounds": 2, "periods": 5, "updates": 3, "batch_size": 16}.items()
)
HANDLED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # by a command
ONCE = "learning.evaluations=1"  # most of a tiny training's time goes into pictures of its evaluations

Once = Callable[..., tuple[Path, Any]]  # the fixture: one worker fills a folder, and what it returned


@dataclass(frozen=True)
class Outcome:
    """The exit code and the output of a command."""

    code: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """The one line that a failed command leaves on stderr."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        return lines[0]


def in_process(
    command: str, *words: str, folder: Path, function: Callable[..., Any] | None = None
) -> Outcome:
    """`cartpole-<command> words...` in `folder`, or with a `function` in place of its own and its checks."""
    GlobalHydra.instance().clear()
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        same_handlers(),
        patch.object(sys, "argv", [f"cartpole-{command}", *words]),
        contextlib.chdir(folder),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            verb = (
                VERBS[command] if function is None else VERBS[command]._replace(function=function, check="")
            )
            run_command(command, verb)
        except SystemExit as exit_:
            code = int(exit_.code or 0)
    return Outcome(code, out.getvalue(), err.getvalue())


@contextlib.contextmanager
def same_handlers() -> Iterator[None]:
    """Give the signals that a command handles their handlers back."""
    handlers = {number: signal.getsignal(number) for number in HANDLED}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def no_pictures() -> Iterator[None]:
    """Draw no figures and no animations, which take most of the time of a tiny run."""
    episodes = "cartpole_rl.reporting.episodes"
    monitor = "cartpole_rl.workflows.train.TrainingMonitor"
    with contextlib.ExitStack() as stack:
        for name in (f"{episodes}.draw", f"{monitor}._log_pictures"):
            stack.enter_context(patch(name, lambda *arguments: None))
        # for that module alone: others that are imported meanwhile would keep a patched function
        unsaved = SimpleNamespace(**{**vars(style), "save": lambda *arguments: None})
        stack.enter_context(patch(f"{episodes}.style", unsaved))
        yield


def interrupt_after(file: Path, number: signal.Signals = signal.SIGINT) -> None:
    """Send a signal to this process as soon as `file` is written, for the first time or again."""
    before = modified(file)

    def interrupt() -> None:
        while modified(file) == before:
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt, daemon=True).start()


def modified(file: Path) -> int | None:
    """Return when a file was written, ns; None if there is none."""
    return file.stat().st_mtime_ns if file.exists() else None


def console_script(command: str, *words: str, folder: Path) -> "subprocess.Popen[str]":
    """`cartpole <command>` in a process of its own, just started."""
    return subprocess.Popen(
        [sys.executable, "-m", "cartpole_rl.cli", command, *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def outcome(process: "subprocess.Popen[str]", timeout: float = 1000) -> Outcome:
    """Wait for a started command, and return its outcome."""
    try:
        out, err = process.communicate(timeout=timeout)
    finally:
        process.kill()
    return Outcome(process.returncode, out, err)


def prints_only_progress(done: Outcome, trainings: int = 1) -> bool:
    """True where trainings printed progress, their track guard and three lines, and nothing of a library.

    A sweep also names its jobs, and prints two lines at its end.
    """
    lines = done.err.replace("\r", "\n").splitlines()
    sweep = trainings > 1
    expected = " M transitions, score ", "cartpole-train: track guard: ", *["cartpole-train: job "] * sweep
    progress = all(any(words in line for words in expected) for line in lines if line.strip())
    return progress and len(done.out.splitlines()) == 3 * trainings + 2 * sweep
