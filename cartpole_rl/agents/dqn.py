"""A DQN agent: the Q-network as a TorchRL actor, its loss with a target network, and its greedy policy."""

from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss
from torchrl.objectives.utils import TargetNetUpdater

from cartpole_rl.agents.network import MirrorQNetwork, QNetwork
from cartpole_rl.settings import Count, Settings


class AgentSettings(Settings):
    """The agent and its loss."""

    hidden: tuple[Count, ...]
    layer_norm: bool
    mirrored: bool  # the network knows that left and right are one problem, reflected
    gamma: Annotated[float, Field(ge=0, lt=1)]
    double: bool  # van Hasselt et al., 2016
    loss: Literal["l2", "smooth_l1"]
    target_tau: Annotated[float, Field(gt=0, le=1)] | None  # Polyak averaging each update
    target_period: Count | None  # or a copy every so many updates
    average_decay: (
        Annotated[float, Field(gt=0, lt=1)] | None
    )  # of the weights that the greedy policy acts with

    @model_validator(mode="after")
    def _one_way_to_move_the_target(self) -> "AgentSettings":
        if (self.target_tau is None) == (self.target_period is None):
            raise ValueError("give either target_tau or target_period, and null for the other")
        return self

    @model_validator(mode="after")
    def _halves_for_the_mirror(self) -> "AgentSettings":
        if self.mirrored and any(size % 2 for size in self.hidden):
            raise ValueError(f"hidden {list(self.hidden)}: a mirrored network needs even numbers of units")
        return self


class QAgent(nn.Module):
    """Online and target Q-network of `actions` outputs.

    `mirror_signs` [K] has +1 or -1 for each number of an observation: what it is multiplied by when left and
    right are swapped.
    """

    updates: Tensor  # gradient steps followed so far, []

    def __init__(self, settings: AgentSettings, mirror_signs: Sequence[int], actions: int) -> None:
        super().__init__()
        self.settings = settings
        layers = actions, settings.hidden, settings.layer_norm
        network = (
            MirrorQNetwork(mirror_signs, *layers)
            if settings.mirrored
            else QNetwork(len(mirror_signs), *layers)
        )
        self.actor = QValueActor(network, in_keys=["observation"], spec=Categorical(actions))
        self.loss = DQNLoss(
            self.actor,
            loss_function=settings.loss,
            delay_value=True,
            double_dqn=settings.double,
            action_space="categorical",
        )
        self.loss.make_value_estimator(gamma=settings.gamma)
        TargetNetUpdater(self.loss)  # copies the weights, and tells the loss that `follow` moves its target
        self.average = self._make_average()
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        self._online, self._target = (
            list(params.values(include_nested=True, leaves_only=True))
            for params in (self.loss.value_network_params, self.loss.target_value_network_params)
        )

    def _make_average(self) -> AveragedModel | None:
        decay = self.settings.average_decay
        return None if decay is None else AveragedModel(self.actor, multi_avg_fn=moving_average(decay))

    @torch.no_grad()
    def follow(self) -> None:
        """Move the target network and the average towards the online one; once after each gradient step."""
        self.updates += 1
        tau, period = self.settings.target_tau, self.settings.target_period
        if tau is not None:
            torch._foreach_lerp_(self._target, self._online, tau)
        elif period is not None and self.updates % period == 0:
            torch._foreach_copy_(self._target, self._online)
        if self.average is not None:
            self.average.update_parameters(self.actor)

    def greedy_policy(self) -> nn.Module:
        """The policy that is evaluated and exported; it follows the weights as they learn.

        With `average_decay` it acts with an exponential average of the online weights over about
        1 / (1 - decay) updates: single updates make the policy lose a start here and there, their mean does
        not (Izmailov et al., "Averaging weights leads to wider optima", 2018). Without, it is the online one.
        """
        return self.actor if self.average is None else self.average.module


def moving_average(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Tensor | int], None]:
    """How weights are averaged: exponentially with `decay`, but over at most the first tenth of the past.

    So the average follows from the first update on, and does not hold the untrained weights for
    1 / (1 - decay) updates.
    """

    def update(averaged: Sequence[Tensor], current: Sequence[Tensor], averages: Tensor | int) -> None:
        weight = max(1 - decay, 9 / (10 + int(averages)))
        torch._foreach_lerp_(list(averaged), list(current), weight)

    return update
