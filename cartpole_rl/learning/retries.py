"""The episodes under way: their scores, and the failed carts that get another one."""

from collections.abc import Mapping
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Generator, Tensor

from cartpole_rl.envs.cart_pole_env import CartPoleEnv

FAILURE_SHARE = 0.5  # of the mean score of a whole episode: one that scores less is a failure
AVERAGED_PERIODS = 1000  # time constant of the mean score of a period


class Retries:
    """Retries of failed carts: after a failed episode a cart is kept for another one with `probability` p.

    Difficult carts are thus driven up to 1 / (1 - p) times as often (after Jiang et al., "Prioritized level
    replay", 2021, and Rajeswaran et al., "EPOpt", 2017).
    """

    def __init__(self, env: CartPoleEnv, probability: float, random: Generator) -> None:
        self.env, self.probability, self.random = env, probability, random
        self._mean_score = 0.0  # of a period
        self._ended: list[tuple[float, int]] = []  # score and length of the ended episodes
        self.reset()

    def reset(self, begun: Tensor | int = 0) -> None:
        """Count from new episodes on every cart, which begin after `begun` [N] periods of their time."""
        self._score = torch.zeros(self.env.batch_size, device=self.env.device)  # of the current episodes
        self._begun = torch.zeros(self.env.batch_size, dtype=torch.long, device=self.env.device) + begun

    def record(self, outcome: TensorDictBase) -> Tensor | None:
        """Add a step to the scores; return the carts to keep, [N] bool, or None if no episode ended."""
        score, done = outcome["score"].squeeze(-1), outcome["done"].squeeze(-1)
        self._score += score
        self._mean_score += (score.mean().item() - self._mean_score) / AVERAGED_PERIODS
        if not done.any():
            return None
        lengths = (outcome["step_count"].squeeze(-1) - self._begun)[done]
        self._ended += zip(self._score[done].tolist(), lengths.tolist(), strict=True)
        chance = torch.rand(self.env.batch_size, generator=self.random, device=self.env.device)
        whole_score = self._mean_score * self.env.hardware.task.periods
        failed = (self._score < FAILURE_SHARE * whole_score) & (self._begun == 0)  # others were cut short
        retry = failed & (chance < self.probability)
        self._score.masked_fill_(done, 0)
        self._begun.masked_fill_(done, 0)
        return retry

    def describe(self) -> dict[str, float]:
        """Return mean score (6.2) and length of the episodes that ended since the last call, if any."""
        if not self._ended:
            return {}
        scores, lengths = zip(*self._ended, strict=True)
        self._ended.clear()
        return {"exploration/score": fmean(scores), "exploration/episode_length": fmean(lengths)}

    def snapshot(self) -> dict[str, Any]:
        """Return the state, to be saved at once."""
        return {
            "score": self._score,
            "begun": self._begun,
            "mean_score": self._mean_score,
            "finished": self._ended,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore the state in `snapshot`."""
        self._score = snapshot["score"].to(self.env.device, copy=True)
        begun = snapshot.get("begun", torch.zeros_like(self._begun))  # missing in earlier versions
        self._begun = begun.to(self.env.device, copy=True)
        self._mean_score, self._ended = snapshot["mean_score"], list(snapshot["finished"])
