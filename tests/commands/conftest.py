"""Runs that several test files share: two trainings (one interrupted), an identification, a fine-tuning."""

from pathlib import Path

import pytest
from command_line import (
    FINETUNING,
    IDENTIFICATION,
    TINY,
    Outcome,
    in_process,
    interrupt_after,
    no_pictures,
    prints_only_progress,
)


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of a tiny training; with two actions its agent always moves the cart."""
    folder = tmp_path_factory.mktemp("trained")
    done = in_process("train", *TINY, "actions=two", "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    assert prints_only_progress(done), done
    return folder / "run"


@pytest.fixture(scope="session")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """The folder and the outcome of a tiny training that was interrupted after its first checkpoint."""
    folder = tmp_path_factory.mktemp("stopped")
    interrupt_after(folder / "run/checkpoints/resume.pt")
    longer = ("actions=two", "learning.transitions=2000000", "learning.evaluations=2000", "hydra.run.dir=run")
    with no_pictures():
        return folder / "run", in_process("train", *TINY, *longer, folder=folder)


@pytest.fixture(scope="session")
def stopped(interrupted: tuple[Path, Outcome]) -> Path:
    """The run folder of the interrupted training."""
    folder, done = interrupted
    assert done.code == 130, done.err
    return folder


@pytest.fixture(scope="session")
def identified(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """The run folder and the outcome of an identification of an emulated cart."""
    folder = tmp_path_factory.mktemp("identified")
    done = in_process("identify", "plant=emulated", *IDENTIFICATION, "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    return folder / "run", done


@pytest.fixture(scope="session")
def tuned(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    """The run folder and the outcome of a short fine-tuning on an emulated cart."""
    folder = tmp_path_factory.mktemp("tuned")
    with no_pictures():
        done = in_process("finetune", f"run={trained}", *FINETUNING, "hydra.run.dir=run", folder=folder)
    assert done.code == 0, done.err
    return folder / "run", done
