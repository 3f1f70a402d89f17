"""Replay: n-step transitions in, batches out."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, PrioritizedSampler, RandomSampler, TensorDictReplayBuffer

from cartpole_rl.learning.settings import ReplaySettings

def make_replay(settings: ReplaySettings, batch_size: int) -> TensorDictReplayBuffer:
    """An empty buffer. Its prioritized sampler draws from NumPy's global generator."""
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


def n_step_transitions(chunk: TensorDictBase, n: int, gamma: float) -> TensorDict:
    """One-step transitions [N, T] to n-step ones [N * T] with the keys that are learned from.

    Return, next observation and end flags are those of the step that is reached: n steps on, or the end of the
    episode, or of the chunk; `steps_to_next_obs` says how many, and the loss discounts by it. TorchRL's MultiStep
    does the same but keeps the flags of the first step, and so bootstraps through an ending.
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
    flat = [carts * periods]
    return TensorDict(
        {
            "observation": chunk["observation"].flatten(0, 1),
            "action": chunk["action"].flatten(0, 1),
            "steps_to_next_obs": (reach + 1).reshape(-1, 1),
            "next": TensorDict(
                {
                    "observation": chunk["next", "observation"][row, reached].flatten(0, 1),
                    "reward": total.reshape(-1, 1),
                    "terminated": chunk["next", "terminated"][row, reached].reshape(-1, 1),
                    "done": chunk["next", "done"][row, reached].reshape(-1, 1),
                },
                batch_size=flat,
            ),
        },
        batch_size=flat,
    )
