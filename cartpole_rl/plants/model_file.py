"""Where a run folder keeps a learned model, without reading it."""

from pathlib import Path

from cartpole_rl.errors import CheckpointError

MODEL = "model.pt"  # in a run folder
REMEDY = "give what cartpole-model wrote"


def find_model(source: Path) -> Path:
    """The model that `source` means: itself, or that of a run folder. Raises CheckpointError."""
    path = source / MODEL if source.is_dir() else source
    if not path.exists():
        missing = f"it holds no {MODEL}" if source.exists() else "there is no such file or folder"
        raise CheckpointError(f"plant.model={source}: {missing}; {REMEDY}")
    return path
