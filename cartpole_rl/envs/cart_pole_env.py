"""The environment: a plant under the hardware transform. `envs.build` builds it."""

from collections.abc import Callable
from functools import cached_property

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.envs.one_cart import OneCart
from cartpole_rl.plants.specs import Plant, tensordict_of


class CartPoleEnv(TransformedEnv):
    """A plant under the hardware transform; `plant` and `hardware` are the two parts.

    `step` and `step_and_maybe_reset` return what TorchRL's TransformedEnv returns, to the bit
    (tests/envs/test_step_and_reset.py), but they call the private `_step` of the plant. TransformedEnv copies
    the tensordict before and after the plant's step, and resets all rows to keep those that ended. A step of
    1024 compiled carts is 1.7 times as fast here (scripts/bench/shortcuts.py). With further transforms
    (`append_transform`) the steps are TransformedEnv's own.
    """

    on_step: Callable[[TensorDictBase], None] | None = None  # called after each step of whole episodes

    @property
    def plant(self) -> Plant:
        """The plant below."""
        return self.base_env

    @property
    def hardware(self) -> HardwareTransform:
        """The hardware transform, alone above the plant or below further transforms."""
        transform = self.transform
        if not isinstance(transform, Compose):
            return transform
        return next(each for each in transform if isinstance(each, HardwareTransform))

    @property
    def _stands_alone(self) -> bool:
        """True if there is no transform but the hardware transform."""
        return isinstance(self.transform, HardwareTransform)

    @cached_property
    def one_cart(self) -> OneCart:
        """The same environment on plain numbers, for a plant of one cart. Raises ConfigError."""
        return OneCart(self.plant, self.hardware)

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step all carts; return `tensordict` with the outcome under "next". Nothing is checked."""
        if not self._stands_alone:
            return super().step(tensordict)
        return tensordict.set("next", self._driven(tensordict))

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step all carts and reset those whose episode ended.

        Return `tensordict` with the outcome under "next", and the tensordict of the next step.
        """
        if not self._stands_alone:
            return super().step_and_maybe_reset(tensordict)
        stepped = tensordict.set("next", self._driven(tensordict))
        return stepped, self.advance(stepped)

    def advance(self, stepped: TensorDictBase, retry: Tensor | None = None) -> TensorDictBase:
        """Return the tensordict of the step after `stepped`; carts whose episode ended are reset.

        Of these, the carts in `retry`, [N] bool, keep their parameters; the others draw new ones.
        """
        outcome = stepped.get("next")
        current = dict(stepped.items()) | dict(outcome.items())
        del current["reward"]  # of the step before
        del current["next"]
        ended = outcome.get("done").squeeze(-1).nonzero().squeeze(-1)
        if len(ended):
            frames = self.plant.restart(ended, None if retry is None else retry[ended])
            first = self.hardware.reset_rows(frames, ended)
            current |= {key: replaced(current[key], ended, value) for key, value in first.items()}
        return tensordict_of(current)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._driven(tensordict) if self._stands_alone else super()._step(tensordict)

    def _driven(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the outcome of a step of the plant under the hardware transform alone."""
        command = self.hardware.command(tensordict)
        return self.hardware.perceive(tensordict, command, self.plant._step(command))


def replaced(values: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    """Return `values` [N, k] with `new` [R, k] in the rows [R]; along the last dimension, which is faster."""
    return values.T.index_copy(1, rows, new.T).T
