"""Collects experience: epsilon-greedy on all carts at once, more of it on carts that it fails with."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from cartpole_rl.envs.make import CartPoleEnv

COLLECTED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
)
FAILED = 0.5  # of what a whole episode usually scores: one that scores less is a failure
USUAL = 1000  # periods that the usual score is the mean of


class Collector:
    """Steps `env` with `policy`, resetting the carts whose episode ended; remembers where it stands.

    A cart whose episode was a failure is not replaced by a new one but tries again, with probability
    `retry_probability` p: carts that are hard to drive are met up to 1 / (1 - p) times as often (after Jiang
    et al., "Prioritized level replay", 2021, and Rajeswaran et al., "EPOpt", 2017).
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
        self._usual = 0.0  # score of a period
        self._generator = torch.Generator(device=env.device)
        self._generator.manual_seed(seed)
        self._finished: list[tuple[float, int]] = []  # score and length of those that ended since last asked
        self.reset()

    def reset(self) -> None:
        """Start a new episode on every cart."""
        self._present = self.env.reset()
        self._score = torch.zeros(self.env.batch_size, device=self.env.device)  # of the episodes under way

    @torch.no_grad()
    def collect(self, periods: int) -> TensorDictBase:
        """Transitions [N, periods] with the keys COLLECTED."""
        taken = []
        for _ in range(periods):
            self._act(self._present)
            stepped = self.env.step(self._present)
            taken.append(stepped.select(*COLLECTED))
            self._present = self.env.advance(stepped, self._tally(stepped["next"]))
        return torch.stack(taken, 1)

    def finished(self) -> dict[str, float]:
        """Mean score (6.2) and length of the episodes that ended since the last call; empty for none."""
        if not self._finished:
            return {}
        scores, lengths = zip(*self._finished, strict=True)
        self._finished.clear()
        return {"score": sum(scores) / len(scores), "episode_length": sum(lengths) / len(lengths)}

    def _tally(self, following: TensorDictBase) -> Tensor | None:
        """Count the step; the carts that try again, [N] bool, of those whose episode ended, if any."""
        score, done = following["score"].squeeze(-1), following["done"].squeeze(-1)
        self._score += score
        self._usual += (score.mean().item() - self._usual) / USUAL
        if not done.any():
            return None
        lengths = following["step_count"].squeeze(-1)[done]
        self._finished += zip(self._score[done].tolist(), lengths.tolist(), strict=True)
        chance = torch.rand(self.env.batch_size, generator=self._generator, device=self.env.device)
        whole = self._usual * self.env.hardware.task.time_limit
        again = (self._score < FAILED * whole) & (chance < self.retry_probability)
        self._score.masked_fill_(done, 0)
        return again

    def _act(self, present: TensorDictBase) -> None:
        carts = self.env.batch_size
        draws = {"generator": self._generator, "device": self.env.device}
        action = torch.randint(self.actions, carts, **draws)
        if self.epsilon < 1:
            explore = torch.rand(carts, **draws) < self.epsilon
            greedy = self.policy(present.select("observation")).get("action")
            action = torch.where(explore, action, greedy)
        present.set("action", action)

    def snapshot(self) -> dict[str, Any]:
        """All that the next chunk depends on, beside the environment's own snapshot."""
        return {
            "present": self._present.to_dict(),
            "score": self._score.clone(),
            "usual": self._usual,
            "finished": list(self._finished),
            "generator": self._generator.get_state(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from `snapshot`."""
        self._present = TensorDict(snapshot["present"], batch_size=self.env.batch_size)
        self._score, self._usual = snapshot["score"].clone(), snapshot["usual"]
        self._finished = list(snapshot["finished"])
        self._generator.set_state(snapshot["generator"])
