"""The hardware transform: a cart that speaks counts and motor values becomes an environment to learn in.

One transform, the same over a simulated and over a serial plant, keeps the stack short (each TorchRL
transform costs more time than the arithmetic in it) and holds no state of its own: what it needs of the past
stands in the tensordict, so a step depends on nothing else.

Keys, each [N, ...]: in `action` int64 index (or NO_ACTION, which sets the motor to 0 and ends the episode);
out `observation` float32, `state` (measured x m, x_dot m/s, theta rad, theta_dot rad/s), `reward` [N, 1],
`score` (6.2) and `score_upright` (6.1) of this step [N, 1], `step_count` int64 [N, 1], `past` (what the
observation remembers), and the plant's own keys.
"""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import Transform

from cartpole_rl.compilation import Compiled
from cartpole_rl.envs.perception import Before, First, Frame, Perceived, perceive, perceive_first
from cartpole_rl.envs.settings import ObservationSettings, RewardSettings, TaskSettings
from cartpole_rl.plants.specs import Plant, tensordict_of
from cartpole_rl.tasks.actions import NO_ACTION
from cartpole_rl.tasks.features import LENGTH_SCALE


class HardwareTransform(Transform):
    """Counts and motor values of a `Plant` to observations, rewards and scores, and back from actions."""

    def __init__(
        self,
        motors: Sequence[int],
        task: TaskSettings,
        observation: ObservationSettings,
        reward: RewardSettings,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        self.task, self.observation_settings, self.reward = task, observation, reward
        self.register_buffer("motors", torch.tensor(list(motors), dtype=torch.int64))
        self.register_buffer("_by_action", torch.tensor([0, *motors], dtype=torch.int64))  # from NO_ACTION on
        self._perceive: Callable[[Before, Frame], Perceived] = partial(
            perceive, settings=observation, task=task, rewards=reward
        )
        if compiled:
            self.compile_arithmetic()

    def compile_arithmetic(self) -> None:
        """Compile what makes observations and rewards of frames, in the next step."""
        self._perceive = Compiled(self._perceive)

    @property
    def plant(self) -> Plant:
        """The plant below."""
        parent = self.parent
        assert parent is not None
        return parent

    # what changes in the specs

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """`motor` is replaced by `action`, an index."""
        motor = action_spec["motor"]
        del action_spec["motor"]
        action_spec["action"] = Categorical(len(self.motors), shape=motor.shape[:1], device=motor.device)
        return action_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the keys that this transform writes."""
        carts, device = observation_spec.shape[0], observation_spec.device
        settings = self.observation_settings
        floats = {"state": 4, "observation": settings.size, "past": settings.past_size}
        for key, size in {**floats, "score": 1, "score_upright": 1}.items():
            observation_spec[key] = Unbounded((carts, size), dtype=torch.float32, device=device)
        observation_spec["step_count"] = Unbounded((carts, 1), dtype=torch.int64, device=device)
        return observation_spec

    # actions down

    def motor_values(self, action: Tensor) -> Tensor:
        """The motor values of actions, int64 of the same shape; 0 for NO_ACTION.

        Raises IndexError for an action that does not exist.
        """
        return self._by_action.index_select(0, action.reshape(-1) - NO_ACTION).reshape(action.shape)

    def command(self, tensordict: TensorDictBase) -> TensorDict:
        """The `motor` values [N, 1] of the actions."""
        return tensordict_of({"motor": self.motor_values(tensordict.get("action")).unsqueeze(-1)})

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.update(self.command(tensordict)) if "action" in tensordict else tensordict

    # frames up

    def reset_rows(self, first: TensorDictBase, rows: Tensor | None = None) -> TensorDictBase:
        """Add to the first frames of the carts `rows` [R] what they mean; None is all carts."""
        counts, label = first.get("counts").T, self._label(rows)
        return added(first, perceive_first(counts, label, self.observation_settings))

    def perceive(
        self, present: TensorDictBase, command: TensorDictBase, following: TensorDictBase
    ) -> TensorDictBase:
        """Add to the frames that followed a `command` given in `present` what they mean."""
        before = Before(
            present.get("counts").T,
            present.get("state").T,
            present.get("past").T,
            present.get("step_count").T,
            command.get("motor").T,
            self._label(),
        )
        frame = Frame(*(following.get(key).T for key in Frame._fields))
        frame = frame._replace(truncated=frame.truncated | (present.get("action") == NO_ACTION))
        return added(following, self._perceive(before, frame))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.reset_rows(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.perceive(tensordict, tensordict, next_tensordict)

    def _label(self, rows: Tensor | None = None) -> Tensor:
        """What is read off the carts `rows`: their poles' scaled lengths, [1, R]; [0, R] if nobody looks."""
        if not self.observation_settings.pole_length:
            return self.motors.new_empty(
                0, self.plant.carts if rows is None else len(rows), dtype=torch.float32
            )
        lengths = self.plant.pole_length if rows is None else self.plant.pole_length[rows]
        return (lengths / LENGTH_SCALE).unsqueeze(0)


def added(frame: TensorDictBase, meaning: First | Perceived) -> TensorDict:
    """The frame [N] with what it means."""
    return tensordict_of(dict(frame.items()) | {key: rows.T for key, rows in meaning._asdict().items()})
