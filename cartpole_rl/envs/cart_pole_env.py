"""The environment: a plant under the hardware transform. `envs.build` builds it.

One cart is also driven on plain numbers, on which a tick takes microseconds. Perception is that of
`perception.py`, and the plant is the one below the TorchRL environment, so both drive the same cart in the
same way (tests/envs/test_one_cart.py).
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, EnvBase, FrameSkipTransform, TransformedEnv

from cartpole_rl.arithmetic.writer import Scalar, plain
from cartpole_rl.envs.hardware import HardwareTransform, finite_actions
from cartpole_rl.envs.perception import Percept, Previous
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput, tensordict_of
from cartpole_rl.tasks.settings import NO_ACTION


class OneCart:
    """One cart under the hardware transform. `reset` starts an episode and `step` drives a period.

    Frames and percepts hold k numbers in place of each tensor [k, N]. Raises ConfigError for an observation
    that the plant cannot give.
    """

    def __init__(self, plant: Plant, hardware: HardwareTransform) -> None:
        self.plant, self.hardware = plant, hardware
        self._motors: list[int] = hardware.motors.tolist()
        self._inward: list[int] = hardware.inward.tolist()
        length, track_end = hardware.scaled_length(), hardware.track_end()
        count, flag = torch.zeros(1, 1, dtype=torch.int64), torch.zeros(1, 1, dtype=torch.bool)
        counts, number = count.repeat(2, 1), torch.zeros(1, 1)
        state, past = number.repeat(4, 1), number.repeat(hardware.observation_settings.past_size, 1)
        speeds = number.repeat(hardware.speed_periods - 1, 1)
        frame = PlantOutput(counts, number, count, flag, flag)
        self._perceive_first = Scalar(
            lambda frame, cart: hardware.first_perception(frame, *cart), frame, (length, track_end)
        )
        previous = Previous(counts, state, past, speeds, count, count, length, track_end)
        self._perceive = Scalar(hardware.perception, previous, frame)
        self._any_period = tuple(
            tuple(plain(torch.ones_like(each)) for each in part) for part in (previous, frame)
        )
        self.frame: PlantOutput[Numbers]  # the newest
        self.sent = 0  # motor value of the newest period
        self.percept: Percept[Numbers]  # of the newest frame

    def motor(self, action: int) -> int:
        """Return the motor value of an action; 0 for NO_ACTION. Raises IndexError if it does not exist."""
        if action == NO_ACTION:
            return 0
        if action < 0:
            raise IndexError(f"action {action} does not exist")
        return self._motors[action]

    def sent_motor(self, action: int) -> int:
        """Return the motor value to send: that of the action, or full motor inward under the track guard."""
        return self.guarded_motor(action, self.percept)

    def guarded_motor(self, action: int, percept: Percept[Numbers]) -> int:
        """Return the motor value that would be sent for an action on a percept."""
        motor, (side,) = self.motor(action), percept.guard
        if side == 0 or action == NO_ACTION:
            return motor
        return self._inward[side]

    def reset(self) -> Percept[Numbers]:
        """Start an episode. Raises the errors of the plant's reset."""
        self.frame = self.plant.reset_one()
        self._length, self._track_end = map(plain, (self.hardware.scaled_length(), self.hardware.track_end()))
        self.percept = self._perceive_first(self.frame, (self._length, self._track_end))
        return self.percept

    def rehearse(self) -> Percept[Numbers]:
        """Perceive a period of ones, which changes nothing."""
        now: Percept[Numbers] = self._perceive(*self._any_period)
        return now

    def step(self, action: int) -> Percept[Numbers]:
        """Drive one period."""
        motor = self.sent_motor(action)
        frame = self.plant.step_one(motor)
        self.sent = self.plant.drove(motor)
        return self.advance(self.sent, frame if action != NO_ACTION else frame._replace(truncated=(True,)))

    def advance(self, motor: int, frame: PlantOutput[Numbers]) -> Percept[Numbers]:
        """Perceive the frame at the end of a period under a motor value."""
        before, earlier, self.frame = self.percept, self.frame.counts, frame
        memory = before.state, before.past, before.speeds, before.step_count
        previous = Previous(earlier, *memory, (motor,), self._length, self._track_end)
        self.percept = self._perceive(previous, frame)
        return self.percept


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

    @property
    def one_cart(self) -> OneCart:
        """The same environment on plain numbers, for a plant of one cart.

        Raises ConfigError for several carts, and for further transforms, which it would leave out.
        """
        if not self._stands_alone:
            further = [type(each).__name__ for each in self.transform if each is not self.hardware]
            raise ConfigError(
                f"an episode of one cart would leave out the environment's {', '.join(further)}: do their "
                "work in the policy"
            )
        return self._one_cart

    @cached_property
    def _one_cart(self) -> OneCart:
        return OneCart(self.plant, self.hardware)

    def append_transform(self, transform: Any, *arguments: Any, **named: Any) -> EnvBase:
        """Append a transform. Raises ConfigError for one that steps several times on the same counts."""
        return super().append_transform(without_frame_skip(transform), *arguments, **named)

    def insert_transform(self, index: int, transform: Any) -> EnvBase:
        """Insert a transform. Raises ConfigError as `append_transform`."""
        return super().insert_transform(index, without_frame_skip(transform))

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step all carts; return `tensordict` with the outcome under "next". Nothing is checked."""
        tensordict = self.with_finite_actions(tensordict)
        if not self._stands_alone or "_step" in tensordict:  # TorchRL skips a step if it masks all carts
            return super().step(tensordict)
        return tensordict.set("next", self._driven(tensordict))

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step all carts and reset those whose episode ended.

        Return `tensordict` with the outcome under "next", and the tensordict of the next step.
        """
        tensordict = self.with_finite_actions(tensordict)
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

    def with_finite_actions(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace actions on numbers that are not finite by NO_ACTION, where the cart may be a real one."""
        if self.plant.drives_one_cart:
            numbers = (tensordict.get(key, None) for key in ("observation", "action_value"))
            tensordict["action"] = finite_actions(tensordict.get("action"), *numbers)
        return tensordict

    def _driven(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the outcome of a step of the plant under the hardware transform alone."""
        command = self.hardware.command(tensordict)
        return self.hardware.perceive(tensordict, command, self.plant._step(command))


def without_frame_skip(transform: Any) -> Any:
    """Return a transform. Raises ConfigError for a frame skip: it would measure n times the velocities."""
    parts = [*transform] if isinstance(transform, Compose) else [transform]
    if any(isinstance(part, FrameSkipTransform) for part in parts):
        raise ConfigError("FrameSkipTransform measures several periods as one; give a longer control_period")
    return transform


def replaced(values: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    """Return `values` [N, k] with `new` [R, k] in the rows [R]; along the last dimension, which is faster."""
    return values.T.index_copy(1, rows, new.T).T
