"""The global random generators: torch's (weights, uniform buffer) and NumPy's (prioritized buffer).

Carts and exploration have separate generators.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seed both generators."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - TorchRL's sampler draws from NumPy's global generator


def random_state() -> dict[str, Any]:
    """Return the state of both generators as tensors and plain values."""
    state = np.random.get_state(legacy=False)  # noqa: NPY002
    numbers = torch.from_numpy(state["state"]["key"].astype(np.int64))  # torch has few uint32 operations
    cuda = {"cuda": torch.cuda.get_rng_state()} if torch.cuda.is_initialized() else {}
    return {
        "torch": torch.get_rng_state(),
        **cuda,
        "numpy": {**state, "state": {**state["state"], "key": numbers}},
    }


def restore_random_state(snapshot: Mapping[str, Any]) -> None:
    """Restore the state that `random_state` returned."""
    torch.set_rng_state(snapshot["torch"])
    if "cuda" in snapshot:
        torch.cuda.set_rng_state(snapshot["cuda"])
    state = snapshot["numpy"]
    numbers = state["state"]["key"].numpy().astype(np.uint32)
    np.random.set_state({**state, "state": {**state["state"], "key": numbers}})  # noqa: NPY002
