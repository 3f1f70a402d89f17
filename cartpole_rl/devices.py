"""The device of a training: the CPU or a CUDA GPU."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from cartpole_rl.errors import ConfigError


def available_device(device: str) -> str:
    """Return "cpu" or "cuda" for `device`, where "auto" is "cuda" if there is a GPU.

    Raises ConfigError for "cuda" without a GPU.
    """
    found = torch.cuda.is_available()
    if device == "auto":
        return "cuda" if found else "cpu"
    if device == "cuda" and not found:
        raise ConfigError(
            "device=cuda: PyTorch finds no CUDA GPU on this machine; start a training with device=cpu "
            "(a resumed one keeps its device)"
        )
    return device


def moved(value: Any, device: torch.device | str) -> Any:
    """Return `value` with all tensors in its mappings, lists and tuples on `device`."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, Mapping):
        return {key: moved(part, device) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(moved(part, device) for part in value)
    return value
