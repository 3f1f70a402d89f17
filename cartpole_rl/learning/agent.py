"""The agent: an online Q-network, its target network, and the average of its weights that drives."""

import copy
from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss
from torchrl.objectives.utils import TargetNetUpdater

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.learning.dqn import AdvantageLearningLoss


class QAgent(nn.Module):
    """The online network `actor`, the target network in `loss`, and the average that acts greedily.

    `mirror_signs` [K] and `frames` [T, F] describe the observation: see `agents.network`.
    """

    updates: Tensor  # gradient steps so far, []

    def __init__(
        self,
        settings: AgentSettings,
        mirror_signs: Sequence[int],
        actions: int,
        frames: Sequence[Sequence[int]] = (),
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__()
        self.settings = settings
        network = settings.network(settings, mirror_signs, actions, frames).to(device)
        self.actor = QValueActor(network, in_keys=["observation"], spec=Categorical(actions))
        self.loss = self.make_loss()
        self.loss.make_value_estimator(gamma=settings.discount, device=device)
        TargetNetUpdater(self.loss)  # copies the weights; `update_target` moves them
        averaged = settings.average_decay is not None
        self.average = copy.deepcopy(self.actor).requires_grad_(False) if averaged else None
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        online, target = self.loss.value_network_params, self.loss.target_value_network_params
        trainable = [name for name, weight in online.items(True, True) if weight.requires_grad]
        networks = online, target, TensorDict.from_module(self.greedy_policy())
        weights = [TensorDict({name: network[name] for name in trainable}).lock_() for network in networks]
        self._online, self._target, self._average = weights

    def make_loss(self) -> DQNLoss:
        """Return the loss of the actor; a subclass may take another one."""
        return AdvantageLearningLoss(
            self.actor,
            action_gap=self.settings.gap,
            loss_function=self.settings.loss,
            delay_value=True,
            double_dqn=self.settings.double,
            action_space="categorical",
        )

    @torch.no_grad()
    def update_target(self) -> None:
        """Move the target network and the average towards the online network, after a gradient step.

        The average spans at most a tenth of the updates, so that the initial weights fade soon.
        """
        self.updates += 1
        settings = self.settings
        if settings.target_tau is not None:
            self._target.lerp_(self._online, settings.target_tau)
        elif settings.target_period is not None and self.updates % settings.target_period == 0:
            self._target.update_(self._online)
        if settings.average_decay is not None:
            newest = max(1 - settings.average_decay, 10 / (9 + int(self.updates)))
            self._average.lerp_(self._online, newest)

    def greedy_policy(self) -> nn.Module:
        """Return the policy that is evaluated and saved; it shares memory with the weights in training.

        An average of the online weights fails less often than the weights after a single update (Izmailov et
        al., "Averaging weights leads to wider optima", 2018). Without `average_decay` they act themselves.
        """
        return self.actor if self.average is None else self.average
