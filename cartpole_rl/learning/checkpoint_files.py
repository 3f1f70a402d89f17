"""The paths of checkpoints: those in a run folder, and the pretrained agents in this package."""

from pathlib import Path

from cartpole_rl.errors import CheckpointError
from cartpole_rl.run_folder import CHECKPOINTS, LAST, RESUME

PRETRAINED = "pretrained"  # run=pretrained/medium is an agent in this package
PRETRAINED_AGENT = "agent.pt"


def find_agent(run: Path) -> Path:
    """Return the checkpoint `run` itself, the last one of a run folder, or a pretrained agent.

    Raises CheckpointError.
    """
    if not run.exists() and run.parts[:1] == (PRETRAINED,):
        return find_pretrained(run)
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


def find_pretrained(run: Path) -> Path:
    """Return the checkpoint of a pretrained agent, such as pretrained/medium. Raises CheckpointError."""
    folder = Path(__file__).parents[1] / PRETRAINED
    path = folder.joinpath(*run.parts[1:]) / PRETRAINED_AGENT
    if not path.is_file():
        names = sorted(agent.parent.name for agent in folder.glob(f"*/{PRETRAINED_AGENT}"))
        choices = ", ".join(f"{PRETRAINED}/{name}" for name in names)
        raise CheckpointError(f"run={run}: there is no such pretrained agent; there are {choices}")
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
