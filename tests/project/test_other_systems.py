"""Without what only POSIX or Linux has, the package is imported, trains and evaluates.

Python's own modules and the libraries are imported before anything is taken away: theirs differ by system.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly
pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

PROGRAM = """
import importlib, os, pkgutil, signal, sys
import torch, torchrl, matplotlib.pyplot, mujoco, serial, hydra, gymnasium, scipy.optimize, tqdm, pydantic
import subprocess, tempfile, socket, multiprocessing.spawn
from torch.utils.tensorboard import SummaryWriter
from contextlib import suppress
with suppress(ImportError):
    import ray  # TorchRL imports it where it is installed

for name in ("fcntl", "termios", "pty", "tty", "resource", "pwd", "grp", "readline", "curses"):
    sys.modules[name] = None
# Python's own shutil needs O_NONBLOCK and O_NOFOLLOW where it found them
posix = "sched_", "SCHED_", "fork", "openpty", "nice", "getuid", "geteuid", "setsid", "killpg", "O_NOCTTY"
for name in [name for name in dir(os) if name.startswith(posix)]:
    delattr(os, name)
for name in ("HUP", "KILL", "QUIT", "ALRM", "USR1", "USR2", "PIPE", "WINCH"):
    delattr(signal, f"SIG{name}")

import cartpole_rl
for module in pkgutil.walk_packages(cartpole_rl.__path__, "cartpole_rl."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)

from cartpole_rl.cli import evaluate, train
for command, words in (
    (train, "compile=false learning.transitions=512 learning.carts=16 learning.chunk=8 learning.updates=1 "
        "learning.batch_size=16 learning.warmup_transitions=64 learning.evaluations=1 buffer.size=1000 "
        "learning.evaluation_episodes=1 task.time_limit=40 hydra.run.dir=trained"),
    (evaluate, "run=trained episodes=1"),
    (evaluate, "run=trained episodes=1 plant=emulated emulator.port=tcp"),
):
    sys.argv = ["cartpole", *words.split()]
    command()
"""


def test_it_trains_and_evaluates_without_posix_and_prints_to_a_pipe_of_windows(tmp_path: Path) -> None:
    """Its encoding is cp1252, which lacks the lines of tables."""
    environment = {**os.environ, "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=environment, capture_output=True, encoding="cp1252"
    )
    assert done.returncode == 0, done.stderr
    assert "plant=emulated, 1 episode" in done.stdout
    assert "????" in done.stdout
