"""The agent: an online Q-network, its target network, and the average of its weights that drives."""

import copy
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.parameter import is_lazy
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss
from torchrl.objectives.utils import TargetNetUpdater

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.errors import ConfigError, reason_of
from cartpole_rl.learning.dqn import AdvantageLearningLoss

TRIED = 64  # observations


class QAgent(nn.Module):
    """The online network `actor`, the target network in `loss`, and the average that acts greedily.

    `mirror_signs` [K] and `frames` [T, F] describe the observation: see `agents.network`. Raises ConfigError
    for a network that `check_network` refuses.
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
        network = settings.network(settings, mirror_signs, actions, frames)
        self.check_network(network, len(mirror_signs), actions)
        network = network.to(device)
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

    def check_network(self, network: Any, observation_size: int, actions: int) -> None:
        """Raise ConfigError for a network that cannot drive; a kind with other outputs replaces this."""
        check_network(self.settings.network, network, observation_size, actions)

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


@torch.no_grad()
def check_network(name: str, network: Any, observation_size: int, actions: int) -> None:
    """Raise ConfigError for a network that gives no action values [N, A], or acts otherwise in training.

    Only trainable weights are averaged, and carts must not change each other's values. Each trainable weight
    needs a gradient and one name. Copies are tried, with other weights: a last layer of zeros hides what is
    before it. Neither the network nor torch's generator changes.
    """
    said = f"agent.network={name}:"
    if not isinstance(network, nn.Module):
        raise ConfigError(f"{said} it returned {type(network).__name__}; return a torch.nn.Module")
    names: dict[Tensor, str] = {}
    for weight_name, weight in network.named_parameters(remove_duplicate=False):
        if is_lazy(weight):
            raise ConfigError(f"{said} it has no size for {weight_name} yet; use Linear, not LazyLinear")
        if (first := names.setdefault(weight, weight_name)) != weight_name and weight.requires_grad:
            raise ConfigError(
                f"{said} it has one weight as {first} and as {weight_name}, which would be trained twice; "
                "give each layer its own"
            )
    generator = torch.Generator().manual_seed(0)
    observations = torch.randn(TRIED, observation_size, generator=generator)
    try:
        with torch.random.fork_rng(devices=[]):
            tried = copy.deepcopy(network)
            for weight in filter(Tensor.is_floating_point, tried.parameters()):
                weight.add_(0.1 * torch.randn(weight.shape, generator=generator))
            training, driving, one = (copy.deepcopy(tried).train(each) for each in (True, False, False))
            with torch.enable_grad():
                values = training(observations)
            if getattr(values, "requires_grad", False):
                values.backward(torch.ones_like(values))
            driven, alone = driving(observations), one(observations[:1])
    except Exception as error:  # of someone's own code
        reason = f"{type(error).__name__}: {reason_of(error)}"
        raise ConfigError(f"{said} it cannot read observations [N, {observation_size}]: {reason}") from error
    shape = list(getattr(values, "shape", [type(values).__name__]))
    if shape != [TRIED, actions]:
        raise ConfigError(
            f"{said} it gave {shape} for observations [{TRIED}, {observation_size}]; "
            f"give action values [{TRIED}, {actions}]"
        )
    weights = training.named_parameters()
    if unused := [each for each, weight in weights if weight.requires_grad and weight.grad is None]:
        raise ConfigError(
            f"{said} it gives action values without a gradient by {unused[0]}; leave that weight out, or "
            "freeze it by requires_grad_(False)"
        )
    alike = partial(torch.allclose, rtol=1e-3, atol=1e-3, equal_nan=True)
    pairs = [(values, driven), (values[:1], alone), *zip(training.buffers(), tried.buffers(), strict=True)]
    if not all(alike(one.double(), other.double()) for one, other in pairs):
        raise ConfigError(
            f"{said} it acts otherwise in training than afterwards, as Dropout and BatchNorm do; use "
            "LayerNorm, or leave them out"
        )
