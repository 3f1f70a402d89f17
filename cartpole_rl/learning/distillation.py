"""Distillation: a small student network learns the action values of a teacher.

The states are those that both visit on simulated carts: cloned from the teacher's states alone, a student
does not learn to correct its own errors (Ross et al., "A reduction of imitation learning and structured
prediction to no-regret online learning", DAgger, 2011).
"""

import math
from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import LearningError
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.settings import DistillationSettings, half_cosine

LAST_RATE = 0.03  # share of the learning rate at the end
Driver = Callable[[TensorDictBase], TensorDictBase]  # from `observation` to `action` and `action_value`


class Distillation:
    """The distillation of the policy `teacher` into `student`, whose greedy policy is `driver`.

    On the carts of `env`: the teacher drives every other one, the student the rest from the second round on.
    """

    def __init__(
        self,
        settings: DistillationSettings,
        teacher: Driver,
        student: QAgent,
        driver: Driver,
        env: CartPoleEnv,
        seed: int,
    ) -> None:
        self.settings, self.student, self.env = settings, student, env
        self._teacher, self._driver = teacher, driver
        self._random = torch.Generator().manual_seed(seed)
        self._by_student = torch.arange(env.plant.carts) % 2 == 0
        self._observations: list[Tensor] = []  # [N, K] for each period
        self._values: list[Tensor] = []  # [N, A], the teacher's
        weights = [weight for weight in student.actor.parameters() if weight.requires_grad]
        self._optimizer = torch.optim.Adam(weights, lr=settings.learning_rate, fused=True)

    @property
    def transitions(self) -> int:
        """Observations so far."""
        return sum(map(len, self._observations))

    def run(self) -> Iterator[float]:
        """Visit states and learn in turn; yield the mean loss of each round. Raises LearningError."""
        current = self.env.reset()
        for number in range(self.settings.rounds):
            current = self._visit(current, first=number == 0)
            yield self._learn(number)

    @torch.no_grad()
    def _visit(self, current: TensorDictBase, first: bool) -> TensorDictBase:
        """Drive all carts for a round, note what the teacher would do, and return the last frame."""
        carts, actions = self.env.plant.carts, len(self.env.hardware.motors)
        for _ in range(self.settings.periods):
            taught = self._teacher(current)
            self._observations.append(current["observation"].clone())
            self._values.append(taught["action_value"].clone())
            action = taught["action"]
            if not first:
                action = self._driver(current)["action"].where(self._by_student, action)
            explores = torch.rand(carts, generator=self._random) < self.settings.epsilon
            action = torch.randint(actions, (carts,), generator=self._random).where(explores, action)
            current = self.env.step_and_maybe_reset(current.set("action", action))[1]
        return current

    def _learn(self, number: int) -> float:
        """Make the updates of a round; return the mean loss."""
        settings = self.settings
        observations, values = torch.cat(self._observations), torch.cat(self._values)
        losses = []
        for update in range(settings.updates):
            progress = (number + update / settings.updates) / settings.rounds
            rate = half_cosine(settings.learning_rate, LAST_RATE * settings.learning_rate, progress)
            for group in self._optimizer.param_groups:
                group["lr"] = rate
            rows = torch.randint(len(observations), (settings.batch_size,), generator=self._random)
            losses.append(self._update(observations[rows], values[rows]))
        return sum(losses) / len(losses)

    def _update(self, observation: Tensor, taught: Tensor) -> float:
        """Make a gradient step on a batch; return the loss. Raises LearningError if it is not finite.

        The policy depends on the advantages alone. The mean value has a small weight: it keeps the student a
        Q-network, which can be fine-tuned.
        """
        batch = TensorDict({"observation": observation}, batch_size=observation.shape[:1])
        values = self.student.actor(batch)["action_value"]
        mean, taught_mean = values.mean(-1, keepdim=True), taught.mean(-1, keepdim=True)
        loss = smooth_l1_loss(values - mean, taught - taught_mean)
        loss = loss + self.settings.value_weight * smooth_l1_loss(mean, taught_mean)
        if not math.isfinite(number := loss.item()):
            raise LearningError("distillation diverged; try a smaller distillation.learning_rate")
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self.student.update_target()
        return number
