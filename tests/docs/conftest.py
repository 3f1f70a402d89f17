"""A folder of a user with a first training in it, and emulated carts behind ports."""

import json
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import BIN, COARSE
from page_commands import BUDGET


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the installed `cartpole-train` has made runs/train/first."""
    folder = tmp_path_factory.mktemp("user")
    words = ("experiment=medium", "hydra.run.dir=runs/train/first", *BUDGET)
    done = subprocess.run([BIN / "cartpole-train", *words], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def serial_port() -> Iterator[Callable[..., str]]:
    """Start `cartpole-emulate` with given settings, return its port, and interrupt it after the test."""
    running: list[subprocess.Popen[str]] = []

    def start(*words: str) -> str:
        command = [BIN / "cartpole-emulate", COARSE, *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout is not None
        return json.loads(process.stdout.readline())["port"]

    yield start
    for process in running:
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=100) in (0, 130)
