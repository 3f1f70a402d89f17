"""Checkpoints: an agent with all that is needed to use it, and the state that training resumes from.

Files are written beside their place and renamed into it, so that a kill at any moment leaves the old one whole.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from cartpole_rl.errors import CheckpointError

AGENT_FORMAT = "cartpole_rl agent 1"
TRAINING_FORMAT = "cartpole_rl training 1"
FOLDER, LAST, BEST, RESUME = "checkpoints", "last.pt", "best.pt", "resume.pt"


@dataclass(frozen=True)
class AgentCheckpoint:
    """An agent's weights and the run that made them."""

    path: Path
    config: dict[str, Any]  # the resolved config of the training
    weights: dict[str, Any]
    frames: int
    score: float | None  # mean score of the evaluation before the checkpoint


def write_atomically(content: Any, path: Path) -> None:
    """`torch.save` that leaves either the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".partial")
    torch.save(content, beside)
    os.replace(beside, path)


def save_agent(path: Path, config: Mapping[str, Any], weights: Any, frames: int, score: float | None) -> None:
    """Write an AgentCheckpoint."""
    write_atomically(
        {"format": AGENT_FORMAT, "config": dict(config), "weights": weights, "frames": frames, "score": score},
        path,
    )


def find_agent(run: Path) -> Path:
    """The checkpoint file that `run` means: itself, or the last one of a run folder."""
    if not run.exists():
        raise CheckpointError(f"run={run}: there is no such file or folder; give a run folder or a checkpoint")
    if run.is_file():
        return run
    path = run / FOLDER / LAST
    if not path.exists():
        raise CheckpointError(f"run={run}: it holds no {FOLDER}/{LAST}; give the folder of a finished training")
    return path


def load_agent(run: Path) -> AgentCheckpoint:
    """Read the agent of a run folder or a checkpoint file. Raises CheckpointError."""
    path = find_agent(run)
    content = _load(path, AGENT_FORMAT, "an agent")
    return AgentCheckpoint(path, content["config"], content["weights"], content["frames"], content["score"])


def load_training(run: Path) -> dict[str, Any]:
    """The state that the training in the folder `run` can go on from. Raises CheckpointError."""
    path = run / FOLDER / RESUME
    if not path.exists():
        raise CheckpointError(f"resume={run}: it holds no {FOLDER}/{RESUME}; only a training leaves one")
    return _load(path, TRAINING_FORMAT, "a training")["state"]


def save_training(run: Path, state: Mapping[str, Any]) -> None:
    """Write what `load_training` reads."""
    write_atomically({"format": TRAINING_FORMAT, "state": dict(state)}, run / FOLDER / RESUME)


def _load(path: Path, expected: str, what: str) -> dict[str, Any]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever the damaged bytes lead it to
        raise CheckpointError(
            f"{path} is no checkpoint of this package, or it is damaged ({type(error).__name__}); "
            f"give one that cartpole-train wrote"
        ) from None
    found = content.get("format") if isinstance(content, dict) else None
    if found != expected:
        raise CheckpointError(f"{path} is not {what} of this package: its format is {found!r}, not {expected!r}")
    return content
