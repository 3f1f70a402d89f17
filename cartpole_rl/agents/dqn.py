"""A DQN agent: the Q-network as a TorchRL actor, its loss with a target network, and its greedy policy."""

from typing import Annotated, Literal

from pydantic import Field, model_validator
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate, SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater

from cartpole_rl.agents.network import QNetwork
from cartpole_rl.settings import Count, Settings


class AgentSettings(Settings):
    """The agent and its loss."""

    hidden: tuple[Count, ...]
    layer_norm: bool
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


class QAgent(nn.Module):
    """Online and target Q-network of `observation_size` inputs and `actions` outputs."""

    def __init__(self, settings: AgentSettings, observation_size: int, actions: int) -> None:
        super().__init__()
        self.settings = settings
        network = QNetwork(observation_size, actions, settings.hidden, settings.layer_norm)
        self.actor = QValueActor(network, in_keys=["observation"], spec=Categorical(actions))
        self.loss = DQNLoss(
            self.actor,
            loss_function=settings.loss,
            delay_value=True,
            double_dqn=settings.double,
            action_space="categorical",
        )
        self.loss.make_value_estimator(gamma=settings.gamma)
        self.target_updater = self._make_target_updater()
        self.average = self._make_average()

    def _make_target_updater(self) -> TargetNetUpdater:
        if self.settings.target_tau is not None:
            return SoftUpdate(self.loss, tau=self.settings.target_tau)
        assert self.settings.target_period is not None
        # HardUpdate fires on every (interval + 1)th step
        return HardUpdate(self.loss, value_network_update_interval=self.settings.target_period - 1)

    def _make_average(self) -> AveragedModel | None:
        decay = self.settings.average_decay
        if decay is None:
            return None
        return AveragedModel(self.actor, multi_avg_fn=get_ema_multi_avg_fn(decay))

    def follow(self) -> None:
        """Move the target network and the average towards the online one; once after each gradient step."""
        self.target_updater.step()
        if self.average is not None:
            self.average.update_parameters(self.actor)

    def greedy_policy(self) -> nn.Module:
        """The policy that is evaluated and exported; it follows the weights as they learn.

        With `average_decay` it acts with an exponential average of the online weights over about
        1 / (1 - decay) updates: single updates make the policy lose a start here and there, their mean does
        not (Izmailov et al., "Averaging weights leads to wider optima", 2018). Without, it is the online one.
        """
        return self.actor if self.average is None else self.average.module
