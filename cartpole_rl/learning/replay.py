"""The replay buffer, TorchRL's, and its state as tensors."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, PrioritizedSampler, RandomSampler, TensorDictReplayBuffer

from cartpole_rl.learning.settings import BufferSettings

# Priorities in the state of TorchRL's PrioritizedSampler, by their private names: they are compiled objects,
# which `torch.load` refuses with weights_only. A sampler whose state holds tensors would replace this.
TREES = ("_sum_tree", "_min_tree")


def make_buffer(
    settings: BufferSettings, batch_size: int, device: torch.device | str = "cpu"
) -> TensorDictReplayBuffer:
    """Return an empty buffer on `device` whose `sample` returns `batch_size` transitions.

    A prioritized one draws from NumPy's global generator, a uniform one from torch's. Its priorities are on
    the CPU on every device: TorchRL has trees on a GPU in its CUDA wheels alone.
    """
    sampler = RandomSampler()
    if settings.kind == "prioritized":
        shape = {"alpha": settings.alpha, "beta": settings.beta[0], "eps": settings.priority_eps}
        sampler = PrioritizedSampler(settings.size, device="cpu", **shape)
    storage = LazyTensorStorage(settings.size, device=device)
    return TensorDictReplayBuffer(
        storage=storage, sampler=sampler, batch_size=batch_size, priority_key="td_error"
    )


def buffer_state(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """Return the state of `buffer`: the filled rows of the storage and the trees.

    A full buffer shares its memory with it.
    """
    filled, transitions = len(buffer), {}
    if filled:
        everything = filled == buffer.storage.max_size
        rows = slice(None) if everything else torch.arange(filled, device=buffer.storage.device)
        transitions = dict(buffer.storage.get(rows).flatten_keys(".").items())
    sampler = buffer.sampler.state_dict()
    trees = {name: torch.as_tensor(sampler[name][torch.arange(filled)]) for name in TREES if name in sampler}
    return {
        "transitions": transitions,
        "writer": buffer.writer.state_dict(),
        "sampler": {**sampler, **trees},
    }


def restore_buffer(buffer: TensorDictReplayBuffer, snapshot: Mapping[str, Any]) -> None:
    """Restore the state that `buffer_state` returned: a tree's nodes follow from its leaves."""
    buffer.empty()
    transitions = snapshot["transitions"]
    if transitions:
        filled = len(next(iter(transitions.values())))
        buffer.extend(TensorDict(transitions, [filled]).unflatten_keys("."))
    sampler, own = dict(snapshot["sampler"]), buffer.sampler.state_dict()
    for name in TREES:
        if name in sampler:
            tree = own[name]
            tree[torch.arange(len(sampler[name]))] = sampler[name]
            sampler[name] = tree
    buffer.sampler.load_state_dict(sampler)
    buffer.writer.load_state_dict(snapshot["writer"])
