"""The paths of the checkpoints in a run folder."""

from pathlib import Path

from cartpole_rl.errors import CheckpointError
from cartpole_rl.run_files import CHECKPOINTS, LAST, RESUME


def find_agent(run: Path) -> Path:
    """Return the checkpoint `run` itself, or the last one of a run folder. Raises CheckpointError."""
    if not run.exists():
        raise CheckpointError(
            f"run={run}: there is no such file or folder; give a run folder or a checkpoint"
        )
    if run.is_file():
        return run
    path = run / CHECKPOINTS / LAST
    if not path.exists():
        raise CheckpointError(f"run={run}: it holds no {CHECKPOINTS}/{LAST}; give the folder of a training")
    return path


def find_training(run: Path) -> Path:
    """Return the file to resume the training in the folder `run` from. Raises CheckpointError."""
    if not run.is_dir():
        raise CheckpointError(f"resume={run}: there is no such folder; give the run folder of a training")
    path = run / CHECKPOINTS / RESUME
    if not path.exists():
        raise CheckpointError(
            f"resume={run}: it holds no {CHECKPOINTS}/{RESUME}; give the folder of a training that was "
            "interrupted after its first checkpoint"
        )
    return path
