"""The state of a training as tensors and plain values: what it resumes from, to the bit.

The largest part of it is the replay buffer, TorchRL's.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import LazyTensorStorage, PrioritizedSampler, RandomSampler, TensorDictReplayBuffer

from cartpole_rl.learning.settings import BufferSettings

# Priorities in the state of TorchRL's PrioritizedSampler, by their private names: they are compiled objects,
# which `torch.load` refuses with weights_only. A sampler whose state holds tensors would replace this.
TREES = ("_sum_tree", "_min_tree")


class Resumable:
    """The part of a `dqn.Training` that saves and restores its state."""

    def snapshot(self: Any) -> dict[str, Any]:
        """Return the state of the training, to be saved at once: it shares memory with the training."""
        return {
            "iteration": self.iteration,
            "seconds": self.seconds,
            "measure": self.measure,
            "scores": [self.best_score, self.last_score],
            "agent": self.agent.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "replay": buffer_state(self.buffer),
            "returns": None if self.waiting is None else self.waiting.to_dict(),
            "collector": {
                "current": self.current.to_dict(),
                "generator": self.random.get_state(),
                **self.retries.snapshot(),
            },
            "plant": self.env.plant.snapshot(),
            "random": random_state(),
        }

    def restore(self: Any, snapshot: Mapping[str, Any]) -> None:
        """Restore the state in `snapshot`; scores in another measure than this training's are forgotten."""
        device, carts = self.env.device, self.env.batch_size
        self.iteration, self.seconds = snapshot["iteration"], snapshot["seconds"]
        collector = on_device(snapshot["collector"], device)
        speeds = torch.zeros(*carts, self.env.hardware.speed_periods - 1, device=device)
        older = "speeds" not in collector["current"]  # a state of earlier versions: speeds over one period
        current = {"speeds": speeds, **collector["current"]}
        same = snapshot.get("measure", "score") == self.measure and not (older and speeds.numel())
        if same:  # the measure is missing in states of earlier versions: (6.2)
            self.best_score, self.last_score = snapshot["scores"]
        else:
            self.best_score, self.last_score = -float("inf"), None
        self.agent.load_state_dict(snapshot["agent"])
        self.optimizer.load_state_dict(snapshot["optimizer"])
        restore_buffer(self.buffer, snapshot["replay"])
        waiting = on_device(snapshot["returns"], device)
        held = self.settings.steps - 1
        self.waiting = None if waiting is None else TensorDict(waiting, [*carts, held])
        self.current = TensorDict(current, carts)
        self.retries.restore(collector)
        self.random.set_state(snapshot["collector"]["generator"])
        self.env.plant.restore(snapshot["plant"])
        restore_random_state(snapshot["random"])


def on_device(value: Any, device: torch.device | str) -> Any:
    """Return `value` with all tensors in its mappings, lists and tuples on `device`."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, Mapping):
        return {key: on_device(part, device) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(on_device(part, device) for part in value)
    return value


def seed_everything(seed: int) -> None:
    """Seed the global generators: torch's (weights, uniform buffer) and NumPy's (prioritized buffer).

    Carts and exploration have generators of their own.
    """
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - TorchRL's sampler draws from NumPy's global generator


def random_state() -> dict[str, Any]:
    """Return the state of the global generators as tensors and plain values."""
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
    return {"transitions": transitions, "writer": buffer.writer.state_dict(), "sampler": {**sampler, **trees}}


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
