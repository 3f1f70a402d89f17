"""Replay: n-step transitions in, batches out."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, PrioritizedSampler, RandomSampler, TensorDictReplayBuffer

from cartpole_rl.learning.settings import BufferSettings

TREES = ("_sum_tree", "_min_tree")  # of priorities, by their names in TorchRL's state of a PrioritizedSampler


def make_replay(settings: BufferSettings, batch_size: int) -> TensorDictReplayBuffer:
    """An empty buffer whose `sample` gives `batch_size` transitions.

    A prioritized one draws from NumPy's global generator, a uniform one from torch's.
    """
    if settings.kind == "prioritized":
        sampler = PrioritizedSampler(
            settings.size, alpha=settings.alpha, beta=settings.beta[0], eps=settings.priority_eps
        )
    else:
        sampler = RandomSampler()
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(settings.size),
        sampler=sampler,
        batch_size=batch_size,
        priority_key="td_error",
    )


def replay_snapshot(replay: TensorDictReplayBuffer) -> dict[str, Any]:
    """Return all that the buffer's next batch depends on, as tensors and plain values.

    Of the storage and the trees it holds the filled rows alone: a buffer has memory for all that it will ever
    hold. A full buffer shares its memory with the snapshot. TorchRL gives its trees as compiled objects,
    which `torch.load` rightly refuses to read from a file.
    """
    filled = len(replay)
    sampler = replay.sampler.state_dict()
    trees = {name: torch.as_tensor(sampler[name][torch.arange(filled)]) for name in TREES if name in sampler}
    return {
        "transitions": _filled_rows(replay.storage, filled),
        "writer": replay.writer.state_dict(),
        "sampler": {**sampler, **trees},
    }


def restore_replay(replay: TensorDictReplayBuffer, snapshot: Mapping[str, Any]) -> None:
    """Go on from `snapshot`. A tree's nodes follow from its leaves, so it comes back to the bit."""
    replay.empty()
    transitions = snapshot["transitions"]
    if transitions:
        filled = len(next(iter(transitions.values())))
        replay.extend(TensorDict(transitions, [filled]).unflatten_keys("."))
    sampler = dict(snapshot["sampler"])
    own = replay.sampler.state_dict()
    for name in TREES:
        if name in sampler:
            tree = own[name]
            tree[torch.arange(len(sampler[name]))] = sampler[name]
            sampler[name] = tree
    replay.sampler.load_state_dict(sampler)
    replay.writer.load_state_dict(snapshot["writer"])


def _filled_rows(storage: LazyTensorStorage, filled: int) -> dict[str, Tensor]:
    """The columns of the first `filled` rows, with memory of their own unless these are all rows."""
    if not filled:
        return {}
    rows = storage.get(range(filled)) if filled < storage.max_size else storage.get(slice(None))
    return dict(rows.flatten_keys(".").items())


class NStepReturns:
    """Turns chunks of one-step transitions into transitions of up to n steps, in the order of collection.

    Without `carry` a return ends where its chunk ends, so the last n - 1 periods of a chunk have shorter
    returns: in a chunk of T >= n periods they have n - n (n - 1) / (2 T) steps on average. With `carry` these
    periods are held back and get their whole returns from the next chunk of the same carts.
    """

    def __init__(self, n: int, gamma: float, carry: bool) -> None:
        self.n, self.gamma = n, gamma
        self.held = n - 1 if carry else 0  # periods
        self.reset()

    def reset(self) -> None:
        """Forget the periods held back: the next chunk does not continue them."""
        self._waiting: TensorDictBase | None = None  # [N, held]

    def __call__(self, chunk: TensorDictBase) -> TensorDict:
        """Return the n-step transitions [N * T] of `chunk` [N, T].

        With `carry` the first call gives [N * (T - n + 1)].
        """
        steps = chunk if self._waiting is None else torch.cat((self._waiting, chunk), 1)
        if self.held:
            self._waiting = steps[:, -self.held :].clone()
        return n_step_transitions(steps, self.n, self.gamma, self.held)

    def snapshot(self) -> dict[str, Any] | None:
        """The periods held back, if any."""
        return None if self._waiting is None else self._waiting.to_dict()

    def restore(self, snapshot: Mapping[str, Any] | None) -> None:
        """Go on from `snapshot`."""
        self.reset()
        if snapshot is not None:
            carts = len(snapshot["action"])
            self._waiting = TensorDict(dict(snapshot), batch_size=[carts, self.held])


def n_step_transitions(chunk: TensorDictBase, n: int, gamma: float, held: int = 0) -> TensorDict:
    """One-step transitions [N, T] to n-step ones [N * (T - held)] with the keys that are learned from.

    Return, next observation and end flags are those of the step that is reached: n steps on, or the end of
    the episode, or of the chunk; `steps_to_next_obs` says how many, and the loss discounts by it. TorchRL's
    MultiStep does the same but keeps the flags of the first step, and so bootstraps through an ending.
    The last `held` periods add to the returns of those before them, and give no transition themselves.
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
    following = chunk["next"][row, reached]
    transitions = TensorDict(
        {
            "observation": chunk["observation"],
            "action": chunk["action"],
            "steps_to_next_obs": (reach + 1).unsqueeze(-1),
            "next": {
                "observation": following["observation"],
                "reward": total.unsqueeze(-1),
                "terminated": following["terminated"],
                "done": following["done"],
            },
        },
        batch_size=[carts, periods],
    )
    return transitions[:, : periods - held].flatten(0, 1)
