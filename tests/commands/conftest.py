"""Runs that several tests use: a training that came to its end, and one that was stopped before."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from command_line import TINY, in_process, tells_only_how_it_goes


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a tiny training; with two actions its agent cannot but move the cart."""
    folder = tmp_path_factory.mktemp("trained")
    done = in_process("train", *TINY, "actions=two", "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    assert tells_only_how_it_goes(done), done
    return folder / "run"


@pytest.fixture(scope="session")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a tiny training that was interrupted once it had something to resume from."""
    folder = tmp_path_factory.mktemp("stopped")

    def interrupt() -> None:
        while not (folder / "run/checkpoints/resume.pt").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    longer = ("actions=two", "learning.transitions=2000000", "learning.evaluations=2000", "hydra.run.dir=run")
    done = in_process("train", *TINY, *longer, folder=folder)
    assert done.code == 130, done.err
    return folder / "run"
