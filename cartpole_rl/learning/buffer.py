"""The replay buffer, and the n-step transitions that it holds."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
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
    if settings.kind == "prioritized":
        sampler = PrioritizedSampler(
            settings.size,
            alpha=settings.alpha,
            beta=settings.beta[0],
            eps=settings.priority_eps,
            device="cpu",
        )
    else:
        sampler = RandomSampler()
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(settings.size, device=device),
        sampler=sampler,
        batch_size=batch_size,
        priority_key="td_error",
    )


def buffer_snapshot(buffer: TensorDictReplayBuffer) -> dict[str, Any]:
    """Return the state of `buffer` as tensors and plain values.

    It holds only the filled rows of the storage and the trees. A full buffer shares its memory with it.
    """
    filled = len(buffer)
    sampler = buffer.sampler.state_dict()
    trees = {name: torch.as_tensor(sampler[name][torch.arange(filled)]) for name in TREES if name in sampler}
    return {
        "transitions": _filled_rows(buffer.storage, filled),
        "writer": buffer.writer.state_dict(),
        "sampler": {**sampler, **trees},
    }


def restore_buffer(buffer: TensorDictReplayBuffer, snapshot: Mapping[str, Any]) -> None:
    """Restore the state in `snapshot`, to the bit: a tree's nodes follow from its leaves."""
    buffer.empty()
    transitions = snapshot["transitions"]
    if transitions:
        filled = len(next(iter(transitions.values())))
        buffer.extend(TensorDict(transitions, [filled]).unflatten_keys("."))
    sampler = dict(snapshot["sampler"])
    own = buffer.sampler.state_dict()
    for name in TREES:
        if name in sampler:
            tree = own[name]
            tree[torch.arange(len(sampler[name]))] = sampler[name]
            sampler[name] = tree
    buffer.sampler.load_state_dict(sampler)
    buffer.writer.load_state_dict(snapshot["writer"])


def _filled_rows(storage: LazyTensorStorage, filled: int) -> dict[str, Tensor]:
    """Return the columns of the first `filled` rows, copied unless these are all rows."""
    if not filled:
        return {}
    everything = filled == storage.max_size
    rows = storage.get(slice(None) if everything else torch.arange(filled, device=storage.device))
    return dict(rows.flatten_keys(".").items())


class NStepReturns:
    """The conversion of consecutive chunks of one-step transitions into transitions of up to n steps.

    Without `carry` a return ends with its chunk, so the last n - 1 periods have shorter returns; the mean
    length in a chunk of T >= n periods is n - n (n - 1) / (2 T) steps. With `carry` these periods wait for
    the next chunk of the same carts, which completes their returns.
    """

    def __init__(self, n: int, gamma: float, carry: bool) -> None:
        self.n, self.gamma = n, gamma
        self.held = n - 1 if carry else 0  # periods
        self.reset()

    def reset(self) -> None:
        """Discard the waiting periods: the next chunk does not continue them."""
        self._waiting: TensorDictBase | None = None  # [N, held]

    def __call__(self, chunk: TensorDictBase) -> TensorDict:
        """Return the n-step transitions [N * T] of `chunk` [N, T].

        With `carry` the first call returns [N * (T - n + 1)].
        """
        steps = chunk if self._waiting is None else torch.cat((self._waiting, chunk), 1)
        if self.held:
            self._waiting = steps[:, -self.held :].clone()
        return n_step_transitions(steps, self.n, self.gamma, self.held)

    def snapshot(self) -> dict[str, Any] | None:
        """Return the waiting periods, if any."""
        return None if self._waiting is None else self._waiting.to_dict()

    def restore(self, snapshot: Mapping[str, Any] | None) -> None:
        """Restore the state in `snapshot`."""
        self.reset()
        if snapshot is not None:
            carts = len(snapshot["action"])
            self._waiting = TensorDict(dict(snapshot), batch_size=[carts, self.held])


def n_step_transitions(chunk: TensorDictBase, n: int, gamma: float, held: int = 0) -> TensorDict:
    """Return the n-step transitions [N * (T - held)] of the one-step transitions `chunk` [N, T].

    A return ends n steps later, or with the episode or the chunk. Next observation and end flags are those of
    its last step; `steps_to_next_obs`, the number of steps, sets the discount in the loss. TorchRL's
    MultiStep keeps the flags of the first step instead, and so bootstraps beyond the end of an episode. The
    last `held` periods only contribute to the returns of earlier ones.
    """
    carts, periods = chunk.batch_size
    reward, done = chunk["next", "reward"].squeeze(-1), chunk["next", "done"].squeeze(-1)  # [N, T]
    total, reach = reward.clone(), torch.zeros_like(reward, dtype=torch.long)
    alive = torch.ones_like(done)
    for ahead in range(1, min(n, periods)):
        alive = alive[:, :-1] & ~done[:, ahead - 1 : -1]  # [N, T - ahead]
        total[:, :-ahead] += gamma**ahead * reward[:, ahead:] * alive
        reach[:, :-ahead] += alive
    reached = torch.arange(periods, device=reward.device) + reach
    row = torch.arange(carts, device=reward.device).unsqueeze(1)
    last = chunk["next"][row, reached]
    transitions = TensorDict(
        {
            "observation": chunk["observation"],
            "action": chunk["action"],
            "steps_to_next_obs": (reach + 1).unsqueeze(-1),
            "next": {
                "observation": last["observation"],
                "reward": total.unsqueeze(-1),
                "terminated": last["terminated"],
                "done": last["done"],
            },
        },
        batch_size=[carts, periods],
    )
    return transitions[:, : periods - held].flatten(0, 1)
