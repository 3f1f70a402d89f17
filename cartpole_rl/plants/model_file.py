"""The path of a learned model in a run folder."""

from pathlib import Path

from cartpole_rl.errors import CheckpointError

MODEL = "model.pt"  # in a run folder
REMEDY = "give a run of cartpole-model"


def find_model(source: Path) -> Path:
    """Return the path of the model: `source`, or the one in a run folder. Raises CheckpointError."""
    path = source / MODEL if source.is_dir() else source
    if not path.exists():
        missing = f"it holds no {MODEL}" if source.exists() else "there is no such file or folder"
        raise CheckpointError(f"plant.model={source}: {missing}; {REMEDY}")
    return path
