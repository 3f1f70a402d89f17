"""Collection of experience: epsilon-greedy on all carts at once, with retries on failed carts."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from cartpole_rl.devices import moved
from cartpole_rl.envs.cart_pole_env import CartPoleEnv

COLLECTED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
)
FAILURE_SHARE = 0.5  # of the mean score of a whole episode: one that scores less is a failure
AVERAGED_PERIODS = 1000  # time constant of the mean score of a period


class Collector:
    """A collector of transitions of `policy` on `env`, which can be saved and restored.

    After a failed episode a cart is kept for another one with probability p, `retry_probability`. Difficult
    carts are thus driven up to 1 / (1 - p) times as often (after Jiang et al., "Prioritized level replay",
    2021, and Rajeswaran et al., "EPOpt", 2017).

    With epsilon 0 and no retries, the transitions equal those of TorchRL's Collector and of `rollout`, to the
    bit (tests/learning/test_collector.py). Those have neither retries nor a state to resume from, and keep
    every key of every step: collecting 8 periods on 1024 compiled carts is 1.25 times as fast here
    (scripts/bench/shortcuts.py).
    """

    def __init__(
        self,
        env: CartPoleEnv,
        policy: TensorDictModuleBase,
        actions: int,
        seed: int,
        retry_probability: float = 0.0,
    ) -> None:
        self.env, self.policy, self.actions = env, policy, actions
        self.epsilon, self.retry_probability = 1.0, retry_probability
        self._mean_score = 0.0  # of a period
        self._generator = torch.Generator(device=env.device)
        self._generator.manual_seed(seed)
        self._finished: list[tuple[float, int]] = []  # score and length of the ended episodes
        self._guarded = torch.zeros((), dtype=torch.int64, device=env.device)  # periods of the track guard
        self._periods = 0  # of all carts, since `guarded_fraction` was read
        self.reset()

    def reset(self) -> None:
        """Start a new episode on every cart."""
        self._current = self.env.reset()
        self._score = torch.zeros(self.env.batch_size, device=self.env.device)  # of the current episodes

    @torch.no_grad()
    def collect(self, periods: int) -> TensorDictBase:
        """Return transitions [N, periods] with the keys COLLECTED."""
        taken, guards = [], []
        for _ in range(periods):
            guards.append(self._current["guard"])
            self._act(self._current)
            stepped = self.env.step(self._current)
            taken.append(stepped.select(*COLLECTED))
            self._current = self.env.advance(stepped, self._record(stepped["next"]))
        chunk: TensorDictBase = torch.stack(taken, 1)
        if self.env.hardware.guard is not None:
            self._guarded += self.env.hardware.guarded(chunk["action"], torch.cat(guards, 1)).sum()
            self._periods += chunk.numel()
        return chunk

    def finished(self) -> dict[str, float]:
        """Return mean score (6.2) and length of the episodes that ended since the last call, if any."""
        if not self._finished:
            return {}
        scores, lengths = zip(*self._finished, strict=True)
        self._finished.clear()
        return {"score": sum(scores) / len(scores), "episode_length": sum(lengths) / len(lengths)}

    def guarded_fraction(self) -> dict[str, float]:
        """Return the share of periods since the last call in which the track guard acted, if there is one.

        It acted if it replaced the agent's motor value.
        """
        if not self._periods:
            return {}
        share = self._guarded.item() / self._periods
        self._guarded.zero_()
        self._periods = 0
        return {"guarded_fraction": share}

    def _record(self, outcome: TensorDictBase) -> Tensor | None:
        """Add the step to the scores; return the carts to keep, [N] bool, or None if no episode ended."""
        score, done = outcome["score"].squeeze(-1), outcome["done"].squeeze(-1)
        self._score += score
        self._mean_score += (score.mean().item() - self._mean_score) / AVERAGED_PERIODS
        if not done.any():
            return None
        lengths = outcome["step_count"].squeeze(-1)[done]
        self._finished += zip(self._score[done].tolist(), lengths.tolist(), strict=True)
        chance = torch.rand(self.env.batch_size, generator=self._generator, device=self.env.device)
        whole_score = self._mean_score * self.env.hardware.task.time_limit
        retry = (self._score < FAILURE_SHARE * whole_score) & (chance < self.retry_probability)
        self._score.masked_fill_(done, 0)
        return retry

    def _act(self, current: TensorDictBase) -> None:
        carts = self.env.batch_size
        draws = {"generator": self._generator, "device": self.env.device}
        action = torch.randint(self.actions, carts, **draws)
        if self.epsilon < 1:
            explore = torch.rand(carts, **draws) < self.epsilon
            greedy = self.policy(current.select("observation")).get("action")
            action = torch.where(explore, action, greedy)
        current.set("action", action)

    def snapshot(self) -> dict[str, Any]:
        """Return the state of the collector, without that of the plant."""
        return {
            "current": self._current.to_dict(),
            "score": self._score.clone(),
            "mean_score": self._mean_score,
            "finished": list(self._finished),
            "guarded": (self._guarded.clone(), self._periods),
            "generator": self._generator.get_state(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the state in `snapshot`."""
        current = moved(snapshot["current"], self.env.device)
        self._current = TensorDict(current, batch_size=self.env.batch_size)
        self._score = snapshot["score"].to(self.env.device, copy=True)
        self._mean_score = snapshot["mean_score"]
        self._finished = list(snapshot["finished"])
        guarded, self._periods = snapshot["guarded"]
        self._guarded.copy_(guarded)
        self._generator.set_state(snapshot["generator"])
