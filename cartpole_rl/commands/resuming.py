"""The training or fine-tuning that resume= goes on with: one that was stopped before its end."""

from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from cartpole_rl.commands.run_folder import PREFIX, check_program, has_ended
from cartpole_rl.errors import ConfigError
from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    TRAINING_FORMAT,
    TrainingCheckpoint,
    load_training,
)

FORMATS = {"train": TRAINING_FORMAT, "finetune": FINETUNING_FORMAT}
LONGER = {  # command: how to go further than a run that has ended
    "train": "cartpole-train with more learning.frames makes a longer training",
    "finetune": "cartpole-finetune run={0} lets it learn on",
}


def resumed(program: str, resume: str | None, folder: Path) -> TrainingCheckpoint | None:
    """Return what cartpole-<program> goes on with in `folder`; None for a new run.

    Raises ConfigError where other settings are given, where the run has ended or is one of another command;
    CheckpointError where there is nothing to go on from.
    """
    if resume is None:
        return None
    given = HydraConfig.get().overrides.task
    if others := [word for word in given if not word.startswith("resume=")]:
        raise ConfigError(f"resume goes on with that run's own config; leave out {', '.join(others)}")
    run = Path(resume)
    check_program("resume", run, program)
    if run.is_dir() and not folder.samefile(run):
        raise ConfigError("resume goes on in that run's own folder; leave out hydra.run.dir")
    if has_ended(run):
        raise ConfigError(
            f"resume={run}: this run of {PREFIX}{program} has ended; cartpole-evaluate run={run} drives its "
            f"agent, {LONGER[program].format(run)}"
        )
    return load_training(run, FORMATS[program])
