"""The greedy policy as a pure function of weights and observation, for driving a cart."""

from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.func import functional_call

from cartpole_rl.compilation import Compiled, Traced
from cartpole_rl.plants.specs import tensordict_of

Weights = dict[str, NDArray[Any]]


def as_weights(policy: nn.Module) -> Weights:
    """Return a copy of the weights of a policy."""
    return {name: value.detach().cpu().numpy().copy() for name, value in policy.state_dict().items()}


class DrivingPolicy:
    """The policy `network`, from `observation` to `action`, optionally `compiled`.

    It shares the network's weights until others are loaded. All calls must have as many carts as the first.
    Its actions are those of the TorchRL module (tests/evaluation/test_driving_policy.py), whose look-ups take
    most of the time of a small network (scripts/bench/shortcuts.py).
    """

    def __init__(self, network: nn.Module, compiled: bool = False) -> None:
        self.network = network
        state = network.state_dict()  # shares memory with the network
        self.names, self._weights = list(state), tuple(state.values())
        self._choose = Compiled(self._compute) if compiled else Traced(self._compute)

    def load(self, weights: Weights) -> None:
        """Act with `weights` from now on."""
        self._weights = tuple(torch.from_numpy(weights[name]) for name in self.names)

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return `action` [N] and `action_value` [N, A] for the `observation` in `tensordict` [N]."""
        action, value = self._choose(self._weights, (tensordict.get("observation"),))
        return tensordict_of({"action": action, "action_value": value})

    def _compute(self, weights: Sequence[Tensor], observations: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return actions and action values as a function of the arguments alone."""
        (observation,) = observations
        tensordict = TensorDict({"observation": observation}, batch_size=observation.shape[:1])
        state = dict(zip(self.names, weights, strict=True))
        chosen = functional_call(self.network, state, (tensordict,))
        return chosen["action"], chosen["action_value"]
