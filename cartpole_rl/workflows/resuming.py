"""resume=: a training or fine-tuning that was stopped before its end."""

from pathlib import Path

from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    TRAINING_FORMAT,
    TrainingCheckpoint,
    load_training,
)
from cartpole_rl.workflows.checks import check_resumable

FORMATS = {"train": TRAINING_FORMAT, "finetune": FINETUNING_FORMAT}


def resumed(program: str, resume: str | None, folder: Path) -> TrainingCheckpoint | None:
    """Return the state from which cartpole-<program> continues in `folder`; None for a new run.

    Raises ConfigError if the run has ended or is of another command, CheckpointError if it holds no
    state.
    """
    if resume is None:
        return None
    check_resumable(program, resume, folder)
    return load_training(Path(resume), FORMATS[program])
