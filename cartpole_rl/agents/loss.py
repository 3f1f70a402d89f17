"""The loss of deep Q-learning, and its gradient as one call."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import DQNLoss

from cartpole_rl.compilation import Compiled

LEARNED_FROM: tuple[NestedKey, ...] = (
    "observation",
    "action",
    "steps_to_next_obs",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
    ("next", "done"),
)
IMPORTANCE: NestedKey = "priority_weight"  # what a prioritized replay adds
Columns = tuple[Tensor, ...]  # of a batch of transitions, in the order LEARNED_FROM, IMPORTANCE
NETWORKS = ("value_network_params", "target_value_network_params")  # their names in TorchRL's loss


class AdvantageLoss(DQNLoss):
    """TorchRL's DQNLoss with `action_gap` alpha's share taken off the rewards; the same where alpha is 0.

    The share is alpha times what the action taken is worth less than the best one, by the network that
    learns: its values are at hand, and a compiled loss computes them once. So the best action stays the best
    one and the others fall back 1 / (1 - alpha) times as far: at 50 Hz a single action changes little, and a
    network that is a little wrong would take the wrong one (Bellemare et al., "Increasing the action gap",
    2016, equation 9).
    """

    def __init__(self, *arguments: Any, action_gap: float, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.action_gap = action_gap

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """`loss` [] of transitions [B], and their `td_error` [B, 1] set in `tensordict`."""
        widened = self.widen_gap(tensordict)
        loss = super().forward(widened)
        tensordict.set("td_error", widened["td_error"])
        return loss

    @torch.no_grad()
    def widen_gap(self, batch: TensorDictBase) -> TensorDictBase:
        """`batch` with the rewards that are learned from."""
        if self.action_gap == 0:
            return batch
        # with the module's state preserved, tensors would become new parameters, constants to a tracer
        with self.value_network_params.to_module(self.value_network, preserve_module_state=False):
            values = self.value_network(batch.select("observation"))["action_value"]
        shortfall = values.max(-1, keepdim=True).values - values.gather(-1, batch["action"].unsqueeze(-1))
        reward = batch["next", "reward"] - self.action_gap * shortfall
        return batch.clone(recurse=False).set(("next", "reward"), reward)


class LossGradient:
    """The gradient of a loss, clipped, in one call; where `compiled`, without any guards.

    `weights` are what is learned; a gradient longer than `max_norm` is shortened to it.
    """

    def __init__(self, loss: DQNLoss, max_norm: float, compiled: bool = False) -> None:
        self.loss, self.max_norm = loss, max_norm
        online, target = (getattr(loss, name) for name in NETWORKS)
        self.names = [key for key, weight in online.items(True, True) if weight.requires_grad]
        self.weights: list[Tensor] = [online[name] for name in self.names]
        self.target: list[Tensor] = [target[name] for name in self.names]
        self._gradient = Compiled(self._pure) if compiled else self._pure

    def __call__(self, columns: Columns) -> tuple[Tensor, Tensor, Tensor]:
        """Sets the gradient of each weight; the loss [], the unclipped norm [], the `td_error` [B, 1]."""
        loss, norm, errors, *gradients = self._gradient(tuple(self.weights), tuple(self.target), columns)
        for weight, gradient in zip(self.weights, gradients, strict=True):
            weight.grad = gradient
        return loss, norm, errors

    def _pure(
        self, weights: Sequence[Tensor], target: Sequence[Tensor], columns: Columns
    ) -> tuple[Tensor, ...]:
        """Loss, norm, errors and gradients as a function of its arguments alone."""
        leaves = [weight.detach().requires_grad_() for weight in weights]
        loss = copy.copy(self.loss)
        for name, values in zip(NETWORKS, (leaves, target), strict=True):
            network = getattr(self.loss, name).data.clone()
            network.update(dict(zip(self.names, values, strict=True)))
            vars(loss)[name] = network  # found before the module's own
        batch = TensorDict(dict(zip((*LEARNED_FROM, IMPORTANCE), columns)), batch_size=columns[0].shape[:1])  # noqa: B905
        with torch.enable_grad():
            value = loss(batch)["loss"]
            gradients = torch.autograd.grad(value, leaves)
        norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
        share = (self.max_norm / norm).clamp(max=1)
        return value.detach(), norm, batch["td_error"].detach(), *(share * each for each in gradients)


def columns_of(transitions: TensorDictBase) -> Columns:
    """What a LossGradient learns from; the importance of each transition is the last, where there is one."""
    keys = [*LEARNED_FROM, *([IMPORTANCE] if IMPORTANCE in transitions else [])]
    return tuple(transitions.get(key) for key in keys)
