"""A DQN agent: the Q-network as a TorchRL actor, its loss with a target network, and its greedy policy."""

import copy
from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives.utils import TargetNetUpdater

from cartpole_rl.agents.loss import AdvantageLearningLoss
from cartpole_rl.agents.network import FrameReader, MirrorQNetwork, QNetwork
from cartpole_rl.agents.settings import AgentSettings


class QAgent(nn.Module):
    """The online and the target Q-network, each with `actions` outputs.

    `mirror_signs` [K] holds the factor, +1 or -1, of each number of an observation when left and right are
    swapped. `frames` [T, F] holds the indices of the frames that a recurrent network reads.
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
        size = len(mirror_signs)
        reader = None if settings.recurrent is None else FrameReader(size, frames, settings.recurrent)
        layers = actions, settings.hidden, settings.layer_norm, reader
        network = MirrorQNetwork(mirror_signs, *layers) if settings.mirrored else QNetwork(size, *layers)
        self.actor = QValueActor(network.to(device), in_keys=["observation"], spec=Categorical(actions))
        self.loss = AdvantageLearningLoss(
            self.actor,
            action_gap=settings.action_gap,
            loss_function=settings.loss,
            delay_value=True,
            double_dqn=settings.double,
            action_space="categorical",
        )
        self.loss.make_value_estimator(gamma=settings.gamma, device=device)
        TargetNetUpdater(
            self.loss
        )  # copies the weights and marks the target as updated; `update_target` moves it
        decay = settings.average_decay
        self.average = None if decay is None else copy.deepcopy(self.actor).requires_grad_(False)
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64))
        online, target = self.loss.value_network_params, self.loss.target_value_network_params
        trainable = [name for name, weight in online.items(True, True) if weight.requires_grad]
        networks = online, target, TensorDict.from_module(self.greedy_policy())
        weights = [TensorDict({name: network[name] for name in trainable}).lock_() for network in networks]
        self._online, self._target, self._average = weights

    @torch.no_grad()
    def update_target(self) -> None:
        """Move the target network and the average towards the online network, after a gradient step."""
        self.updates += 1
        tau, period = self.settings.target_tau, self.settings.target_period
        if tau is not None:
            self._target.lerp_(self._online, tau)
        elif period is not None and self.updates % period == 0:
            self._target.update_(self._online)
        if self.average is not None:
            self._average.lerp_(self._online, self._newest_share())

    def _newest_share(self) -> float:
        """Return the share of the newest weights in the average, which spans a tenth of the updates or less.

        The initial weights therefore fade sooner than after 1 / (1 - decay) updates.
        """
        assert self.settings.average_decay is not None
        return max(1 - self.settings.average_decay, 10 / (9 + int(self.updates)))

    def greedy_policy(self) -> nn.Module:
        """Return the policy that is evaluated and saved; it shares memory with the weights in training.

        With `average_decay` it acts with an exponential average of the online weights over about
        1 / (1 - decay) updates, which fails less often than the policy after a single update (Izmailov et
        al., "Averaging weights leads to wider optima", 2018). Otherwise it is the online network.
        """
        return self.actor if self.average is None else self.average
