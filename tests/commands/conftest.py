"""Runs that several test files share; two are trainings, of which one was interrupted."""

from pathlib import Path

import pytest
from command_line import (
    ENSEMBLE,
    FINETUNING,
    IDENTIFICATION,
    TINY,
    Once,
    Outcome,
    in_process,
    interrupt_after,
    no_pictures,
    prints_only_progress,
)


@pytest.fixture(scope="session")
def trained(once: Once) -> Path:
    """The run folder of a tiny training; with two actions its agent always moves the cart."""

    def make(folder: Path) -> Outcome:
        done = in_process("train", *TINY, "actions=two", "hydra.run.dir=run", folder=folder)
        assert done.code == 0, done.err
        assert prints_only_progress(done), done
        return done

    return once("trained", make)[0]


@pytest.fixture(scope="session")
def interrupted(once: Once) -> tuple[Path, Outcome]:
    """The folder and the outcome of a tiny training that was interrupted after its first checkpoint."""
    longer = ("actions=two", "learning.transitions=2000000", "learning.evaluations=2000", "hydra.run.dir=run")

    def make(folder: Path) -> Outcome:
        interrupt_after(folder / "run/checkpoints/resume.pt")
        with no_pictures():
            return in_process("train", *TINY, *longer, folder=folder)

    return once("stopped", make)


@pytest.fixture(scope="session")
def stopped(interrupted: tuple[Path, Outcome]) -> Path:
    """The run folder of the interrupted training."""
    folder, done = interrupted
    assert done.code == 130, done.err
    return folder


@pytest.fixture(scope="session")
def identified(once: Once) -> tuple[Path, Outcome]:
    """The run folder and the outcome of an identification of an emulated cart."""

    def make(folder: Path) -> Outcome:
        done = in_process("identify", "plant=emulated", *IDENTIFICATION, "hydra.run.dir=run", folder=folder)
        assert done.code == 0, done.err
        return done

    return once("identified", make)


@pytest.fixture(scope="session")
def tuned(once: Once, trained: Path) -> tuple[Path, Outcome]:
    """The run folder and the outcome of a short fine-tuning on an emulated cart."""

    def make(folder: Path) -> Outcome:
        with no_pictures():
            done = in_process("finetune", f"run={trained}", *FINETUNING, "hydra.run.dir=run", folder=folder)
        assert done.code == 0, done.err
        return done

    return once("tuned", make)


@pytest.fixture(scope="session")
def recorded(once: Once) -> Path:
    """The run folder of two recorded episodes of the nominal cart."""

    def make(folder: Path) -> None:
        done = in_process("record", "run=lqr", "episodes=2", "hydra.run.dir=run", folder=folder)
        assert done.code == 0, done.err

    return once("recorded", make)[0]


@pytest.fixture(scope="session")
def learned(once: Once, recorded: Path) -> tuple[Path, Outcome]:
    """The run folder and the outcome of a small ensemble; one of its two recordings is given twice."""
    both = ",".join(str(recorded / f"recordings/episode_00{number}.csv") for number in (0, 1, 0))

    def make(folder: Path) -> Outcome:
        done = in_process("model", f"from=[{both}]", *ENSEMBLE, "hydra.run.dir=run", folder=folder)
        assert done.code == 0, done.err
        return done

    return once("learned", make)
