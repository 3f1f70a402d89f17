"""Checkpoints: an agent with its config, and the state that a training resumes from.

Files are replaced atomically (`cartpole_rl.files`).
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import torch
from pydantic import TypeAdapter, ValidationError
from torch import nn

from cartpole_rl.errors import CheckpointError
from cartpole_rl.files import replacing
from cartpole_rl.learning.states import on_device
from cartpole_rl.run_folder import CHECKPOINTS, ERROR, RESUME, find_agent, find_training

AGENT_FORMAT = "cartpole_rl agent 1"
TRAINING_FORMAT = "cartpole_rl training 4"
FINETUNING_FORMAT = "cartpole_rl fine-tuning 3"
CONTENT = {  # format: what a file of it holds
    AGENT_FORMAT: "an agent",
    TRAINING_FORMAT: "the state that a training resumes from",
    FINETUNING_FORMAT: "the state that a fine-tuning resumes from",
}


@dataclass(frozen=True)
class AgentCheckpoint:
    """The weights of an agent and the config of its training."""

    config: dict[str, Any]  # the resolved config of the training
    weights: dict[str, Any]
    transitions: int
    score: float | None  # mean score of the evaluation before the checkpoint
    tuned_poles: list[dict[str, Any]] = field(default_factory=list)  # PoleSettings of carts it was tuned on


@dataclass(frozen=True)
class TrainingCheckpoint:
    """The state that a training or a fine-tuning resumes from."""

    config: dict[str, Any]
    state: dict[str, Any]  # of `Training.snapshot` or `CartLearner.snapshot`
    step: int  # on the axis of TensorBoard: transitions of a training, episodes of a fine-tuning
    drawn_from: dict[str, str] = field(default_factory=dict)  # SHA-256 of files that the carts come from


Checkpoint = TypeVar("Checkpoint", AgentCheckpoint, TrainingCheckpoint)


def save_agent(path: Path, agent: AgentCheckpoint) -> None:
    """Write a checkpoint for `load_agent`.

    Raises CheckpointError if a weight is not finite, without changing the file.
    """
    check_finite(agent.weights, f"{path} is not written")
    _save(path, AGENT_FORMAT, vars(agent))


def load_agent(run: Path) -> AgentCheckpoint:
    """Read the agent of a run folder or a checkpoint file. Raises CheckpointError."""
    path = find_agent(run)
    agent = _load(path, AGENT_FORMAT, AgentCheckpoint)
    check_finite(agent.weights, f"{path} is refused")
    return agent


def restore_weights(agent: nn.Module, weights: Mapping[str, Any], source: str) -> None:
    """Load the weights of a checkpoint into `agent`. Raises CheckpointError if they do not fit."""
    try:
        agent.load_state_dict(weights)
    except (RuntimeError, ValueError):  # by name, a line for each weight; or by shape
        raise CheckpointError(
            f"{source} is of another version of this package: its network has other weights; train it again"
        ) from None


def check_finite(weights: Mapping[str, Any], consequence: str) -> None:
    """Raise CheckpointError if a weight is not finite."""
    for name, weight in weights.items():
        if isinstance(weight, torch.Tensor) and not weight.isfinite().all():
            raise CheckpointError(
                f"{consequence}: its weight {name} is not finite, the training has diverged; "
                "take an earlier checkpoint, or train again with a smaller learning rate"
            )


def save_training(run: Path, training: TrainingCheckpoint, file_format: str = TRAINING_FORMAT) -> None:
    """Write the state for `load_training`. Raises CheckpointError if a weight is not finite."""
    path = run / CHECKPOINTS / RESUME
    check_finite(training.state.get("agent", {}), f"{path} is not written")
    _save(path, file_format, vars(training))


def forget_training(run: Path) -> None:
    """Remove the files of an unfinished training: its state and the error of a sweep's job."""
    (run / CHECKPOINTS / RESUME).unlink(missing_ok=True)
    (run / ERROR).unlink(missing_ok=True)


def load_training(run: Path, file_format: str = TRAINING_FORMAT) -> TrainingCheckpoint:
    """Read the state to resume the training in the folder `run` from. Raises CheckpointError."""
    path = find_training(run)
    training = _load(path, file_format, TrainingCheckpoint)
    weights = training.state.get("agent", {})
    if not isinstance(weights, dict):
        raise _damaged(path, "its agent is no dictionary")
    check_finite(weights, f"{path} is refused")
    return training


@contextmanager
def whole_state(source: str) -> Iterator[None]:
    """Raise CheckpointError that names `source` if the state which is restored lacks a part."""
    try:
        yield
    except KeyError as error:
        raise CheckpointError(
            f"{source} is damaged, or of another version of this package: its state lacks {error}; start anew"
        ) from None


def _save(path: Path, file_format: str, content: Mapping[str, Any]) -> None:
    with replacing(path) as beside, beside.open("wb") as file:  # with a path, torch hides why writing failed
        torch.save({"format": file_format, **on_device(content, "cpu")}, file)


def _load(path: Path, expected: str, kind: type[Checkpoint]) -> Checkpoint:
    """Return the checkpoint in a file. Raises CheckpointError for another format, and for damaged parts."""
    content = _content(path, expected)
    try:
        checkpoint = kind(**content)
    except TypeError:  # a part is missing or unknown
        raise _damaged(path, f"its parts are {', '.join(map(str, content))}") from None
    for name, annotation in get_type_hints(kind).items():
        try:
            TypeAdapter(annotation).validate_python(getattr(checkpoint, name), strict=True)
        except ValidationError as error:
            raise _damaged(path, f"{name}: {error.errors()[0]['msg']}") from None
    return checkpoint


def _damaged(path: Path, why: str) -> CheckpointError:
    return CheckpointError(
        f"{path} is damaged, or of another version of this package: {why}; give another one"
    )


def _content(path: Path, expected: str) -> dict[str, Any]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load raises errors of many kinds for damaged files
        own = "; a policy of your own is run=module:name" if expected == AGENT_FORMAT else ""
        raise CheckpointError(
            f"{path} is not a checkpoint of this package, or is damaged ({type(error).__name__}); "
            f"give one that cartpole-train wrote{own}"
        ) from None
    found = content.pop("format", None) if isinstance(content, dict) else None
    if found != expected:
        held = f"it is {CONTENT[found]}" if found in CONTENT else f"its format is {found!r}, not {expected!r}"
        if str(found).startswith(expected.rstrip("0123456789")):
            held += ", but that of another version; use that version, or start anew"
        raise CheckpointError(f"{path} is not {CONTENT[expected]} of this package: {held}")
    return content
