"""The loss of deep Q-learning with an action gap, and its gradient as one call."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import DQNLoss, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator, distance_loss

from cartpole_rl.compilation import Compiled

LOSS_KEYS: tuple[NestedKey, ...] = (
    "observation",
    "action",
    "steps_to_next_obs",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "terminated"),
)
IMPORTANCE_WEIGHT: NestedKey = "priority_weight"  # added by a prioritized buffer
Columns = tuple[Tensor, ...]  # of a batch of transitions: LOSS_KEYS, then IMPORTANCE_WEIGHT if there is one


class AdvantageLearningLoss(DQNLoss):
    """TorchRL's DQNLoss with the target of advantage learning; equal to it if `action_gap` is 0.

    It takes the arguments of DQNLoss and `action_gap`, alpha in [0, 1). Advantage learning keeps the value of
    the best action and widens its lead over each other action 1 / (1 - alpha) times: at 50 Hz one action
    changes little, and small errors of the network would hide the best one.
    """

    def __init__(self, *arguments: Any, action_gap: float = 0.0, **named: Any) -> None:
        super().__init__(*arguments, **named)
        if not 0 <= action_gap < 1:
            raise ValueError(f"action_gap={action_gap}: give at least 0 and less than 1")
        if self.action_space not in ("categorical", "one_hot"):
            raise ValueError(f"action_space={self.action_space}: give categorical or one-hot")
        self.action_gap = action_gap

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the `loss` [] of transitions [B]; set their squared TD errors `td_error` [B, 1] in them.

        A transition spans n = `steps_to_next_obs` [B, 1] steps, 1 if that is missing; its reward is their
        discounted sum. theta are the online weights, theta- those of the target network.
        """
        keys, next_tensordict = self.tensor_keys, tensordict["next"]
        reward, alive = next_tensordict[keys.reward], ~next_tensordict[keys.terminated]  # [B, 1]
        action = tensordict[keys.action]
        index = action.long().argmax(-1) if self.action_space == "one_hot" else action
        values = self._values(tensordict, self.value_network_params)  # Q(s, .; theta) [B, A]
        value = values.gather(-1, index.view_as(reward))  # Q(s, a; theta) [B, 1]
        with torch.no_grad():
            # Double DQN: van Hasselt et al. 2016 (arXiv:1509.06461), eq. 4 (theta' is theta-); or DQN: eq. 3
            next_values = self._values(
                next_tensordict, self.target_value_network_params
            )  # Q(s', .; theta-) [B, A]
            chooser = (
                self._values(next_tensordict, self.value_network_params) if self.double_dqn else next_values
            )
            next_value = next_values.gather(-1, chooser.argmax(-1, keepdim=True))
            # n steps: Sutton and Barto 2018, eq. 7.1. No value after the end: Mnih et al. 2015, algorithm 1
            steps = tensordict.get("steps_to_next_obs", torch.ones_like(reward)).view_as(reward)
            discount = alive * self.value_estimator.gamma**steps
            # Advantage learning: Bellemare et al. 2016 (arXiv:1512.04860), eq. 9; V - Q by theta
            shortfall = values.max(-1, keepdim=True).values - value
            target = reward - self.action_gap * shortfall + discount * next_value
        tensordict.set(keys.priority, (value - target).detach().square())
        # Squared error, or Huber's with delta 1 (Huber 1964; "error clipping" in Mnih et al. 2015, Methods)
        loss = distance_loss(value, target, self.loss_function).squeeze(-1)  # [B]
        # Mean, or sum(w loss) / sum(w) with importance weights w: Schaul et al. 2016 (arXiv:1511.05952), 3.4.
        # TorchRL has no public function for masks and `reduction`: its own losses also call `_reduce_loss`
        weights = tensordict.get(keys.priority_weight, None) if self.use_prioritized_weights else None
        return TensorDict(loss=self._reduce_loss(loss, tensordict=tensordict, weights=weights))

    def _values(self, tensordict: TensorDictBase, weights: TensorDictBase) -> Tensor:
        """Return the values of all actions [B, A] by the network with `weights`."""
        # with the module's state preserved, tensors would become new parameters, constants to a tracer
        with weights.to_module(self.value_network, preserve_module_state=False):
            observed = tensordict.select(*self.value_network.in_keys)
            return self.value_network(observed)[self.tensor_keys.action_value]

    def make_value_estimator(
        self, value_type: Any = ValueEstimators.TD0, *, gamma: float = 0.99, device: Any = None
    ) -> None:
        """Set the discount factor. Raises NotImplementedError for any estimator but TD0."""
        dispatch_value_estimator(
            self, value_type, supported=[ValueEstimators.TD0], gamma=gamma, device=device
        )


class LossGradient:
    """The clipped gradient of a loss as one call, optionally `compiled`.

    It equals `loss.backward()` followed by clipping to `max_norm` (tests/agents/test_dqn.py). Compiled,
    it takes 0.3 of the time for 512 transitions (scripts/bench/shortcuts.py): no module look-ups, no guards,
    few kernels. `weights` are the trainable weights.
    """

    def __init__(self, loss: DQNLoss, max_norm: float, compiled: bool = False) -> None:
        self.loss, self.max_norm = loss, max_norm
        state = dict(TensorDict.from_module(loss).items(True, True))
        self._trainable = {name: weight for name, weight in state.items() if weight.requires_grad}
        self._fixed = {name: weight for name, weight in state.items() if not weight.requires_grad}
        self.weights: list[Tensor] = list(self._trainable.values())
        self._gradient = Compiled(self._compute) if compiled else self._compute

    def __call__(self, columns: Columns) -> tuple[Tensor, Tensor, Tensor]:
        """Set the gradient of each weight; return loss [], unclipped norm [] and `td_error` [B, 1]."""
        fixed = tuple(self._fixed.values())
        loss, norm, errors, *gradients = self._gradient(tuple(self.weights), fixed, columns)
        for weight, gradient in zip(self.weights, gradients, strict=True):
            weight.grad = gradient
        return loss, norm, errors

    def _compute(
        self, trainable: Sequence[Tensor], fixed: Sequence[Tensor], columns: Columns
    ) -> tuple[Tensor, ...]:
        """Return loss, norm, errors and gradients as a pure function of weights and batch."""
        leaves = [weight.detach().requires_grad_() for weight in trainable]
        state = TensorDict(dict(zip((*self._trainable, *self._fixed), (*leaves, *fixed), strict=True)))
        keys = (*LOSS_KEYS, IMPORTANCE_WEIGHT)[: len(columns)]
        batch = TensorDict(dict(zip(keys, columns, strict=True)), batch_size=columns[0].shape[:1])
        with state.to_module(self.loss, preserve_module_state=False), torch.enable_grad():
            loss = self.loss(batch)["loss"]
            gradients = torch.autograd.grad(loss, leaves)
        norm = torch.stack([gradient.square().sum() for gradient in gradients]).sum().sqrt()
        share = (self.max_norm / norm).clamp(max=1)
        return loss.detach(), norm, batch["td_error"], *(share * each for each in gradients)


def columns_of(transitions: TensorDictBase) -> Columns:
    """Return the columns that a LossGradient takes."""
    keys = [*LOSS_KEYS, *([IMPORTANCE_WEIGHT] if IMPORTANCE_WEIGHT in transitions else [])]
    return tuple(transitions.get(key) for key in keys)
