"""The policy that drives: a network as a function of its weights, which may come from elsewhere."""

from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.func import functional_call

from cartpole_rl.compilation import Compiled
from cartpole_rl.plants.specs import tensordict_of

Weights = dict[str, NDArray[Any]]


def as_weights(policy: nn.Module) -> Weights:
    """The weights of a policy, copied."""
    return {name: value.detach().cpu().numpy().copy() for name, value in policy.state_dict().items()}


class DrivingPolicy:
    """The policy `network`, from `observation` to `action`; where `compiled`, as one call.

    It follows the network's weights as they change, until others are loaded. TorchRL's modules take most of
    a small network's time to look up what is where.
    """

    def __init__(self, network: nn.Module, compiled: bool) -> None:
        self.network = network
        state = network.state_dict()  # shares memory with the network
        self.names, self._weights = list(state), tuple(state.values())
        self._choose = Compiled(self._pure) if compiled else self._pure

    def load(self, weights: Weights) -> None:
        """Act with these from now on."""
        self._weights = tuple(torch.from_numpy(weights[name]) for name in self.names)

    def __call__(self, present: TensorDictBase) -> TensorDictBase:
        """The `action` [N] for the `observation` of `present` [N], and the `action_value` [N, A]."""
        action, value = self._choose(self._weights, (present.get("observation"),))
        return tensordict_of({"action": action, "action_value": value})

    def _pure(self, weights: Sequence[Tensor], seen: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Actions and action values as a function of its arguments alone."""
        present = TensorDict({"observation": seen[0]}, batch_size=seen[0].shape[:1])
        state = dict(zip(self.names, weights, strict=True))
        chosen = functional_call(self.network, state, (present,))
        return chosen["action"], chosen["action_value"]
