"""Collects experience: epsilon-greedy on all carts at once."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

COLLECTED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
)


class Collector:
    """Steps `env` with `policy`, resetting the carts whose episode ended; remembers where it stands."""

    def __init__(self, env: EnvBase, policy: TensorDictModuleBase, actions: int, seed: int) -> None:
        self.env, self.policy, self.actions = env, policy, actions
        self.epsilon = 1.0
        self._generator = torch.Generator(device=env.device)
        self._generator.manual_seed(seed)
        self._finished: list[tuple[float, int]] = []  # score and length of those that ended since last asked
        self.begin()

    def begin(self) -> None:
        """Start a new episode on every cart."""
        self._present = self.env.reset()
        self._score = torch.zeros(self.env.batch_size, device=self.env.device)  # of the episodes under way

    @torch.no_grad()
    def collect(self, periods: int) -> TensorDictBase:
        """Transitions [N, periods] with the keys COLLECTED."""
        taken = []
        for _ in range(periods):
            self._act(self._present)
            transition, self._present = self.env.step_and_maybe_reset(self._present)
            taken.append(transition.select(*COLLECTED))
            self._tally(transition["next"])
        return torch.stack(taken, 1)

    def finished(self) -> dict[str, float]:
        """Mean score (6.2) and length of the episodes that ended since the last call; empty for none."""
        if not self._finished:
            return {}
        scores, lengths = zip(*self._finished, strict=True)
        self._finished.clear()
        return {"score": sum(scores) / len(scores), "episode_length": sum(lengths) / len(lengths)}

    def _tally(self, following: TensorDictBase) -> None:
        self._score += following["score"].squeeze(-1)
        done = following["done"].squeeze(-1)
        if done.any():
            lengths = following["step_count"].squeeze(-1)[done].tolist()
            self._finished += zip(self._score[done].tolist(), lengths, strict=True)
            self._score.masked_fill_(done, 0)

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
            "finished": list(self._finished),
            "generator": self._generator.get_state(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from `snapshot`."""
        self._present = TensorDict(snapshot["present"], batch_size=self.env.batch_size)
        self._score = snapshot["score"].clone()
        self._finished = list(snapshot["finished"])
        self._generator.set_state(snapshot["generator"])
