"""The hardware transform: a cart that speaks counts and motor values becomes an environment to learn in.

One transform, the same over a simulated and over a serial plant, keeps the stack short (each TorchRL
transform costs more time than the arithmetic in it) and holds no state of its own: what it needs of the past
stands in the tensordict, so a step depends on nothing else.

Keys, each [N, ...]: in `action` int64 index; out `observation` float32, `state` (measured x m, x_dot m/s,
theta rad, theta_dot rad/s), `reward` [N, 1], `score` (6.2) and `score_upright` (6.1) of this step [N, 1],
`step_count` int64 [N, 1], `past` (what the observation remembers), and the plant's own keys.
"""

from collections.abc import Sequence

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import Transform

from cartpole_rl.plants.specs import Plant
from cartpole_rl.settings import Count, Finite, NonNegative, Positive, Settings
from cartpole_rl.tasks.endings import fallen
from cartpole_rl.tasks.features import (
    ANGULAR_SPEED_SCALE,
    LENGTH_SCALE,
    MIRROR_SIGNS,
    MOTOR_SCALE,
    SPEED_SCALE,
    ObservationKind,
    measured_position,
    measured_velocity,
    observation_size,
    observe,
)
from cartpole_rl.tasks.rewards import REWARDS, SCORE, SCORE_UPRIGHT, Reward
from cartpole_rl.tasks.starts import StartSettings


class ObservationSettings(Settings):
    """What the agent sees beside the present measured state."""

    kind: ObservationKind
    past_motors: int = Field(ge=0, le=16)  # the last so many motor values
    past_velocities: int = Field(ge=0, le=16)  # the velocities so many periods back
    pole_length: bool  # the length of the pole, known from a label on it

    @property
    def past_size(self) -> int:
        """Numbers of the past: motor values, newest first, then velocities, newest first."""
        return self.past_motors + 2 * self.past_velocities

    @property
    def size(self) -> int:
        """Numbers in an observation."""
        return observation_size(self.kind) + self.past_size + int(self.pole_length)

    @property
    def mirror_signs(self) -> list[int]:
        """What each number of an observation is multiplied by when left and right are swapped, [size]."""
        return [*MIRROR_SIGNS[self.kind], *[-1] * self.past_size, *[1] * self.pole_length]

    @property
    def kept_columns(self) -> list[int]:
        """What a step keeps of (newest motor value, past, newest velocities): the past of the next step."""
        motors = range(self.past_motors)
        older_velocities = range(1 + self.past_motors, 1 + self.past_size)
        velocities = (1 + self.past_size, 2 + self.past_size, *older_velocities)
        return [*motors, *velocities[: 2 * self.past_velocities]]


class RewardSettings(Settings):
    """What the agent learns from: `kind` times `scale`, less `track_penalty` for leaving the track."""

    kind: Reward
    scale: Positive
    track_penalty: NonNegative


class TaskSettings(Settings):
    """What is asked of the cart."""

    name: str
    start: StartSettings  # where training starts
    evaluation_start: StartSettings
    time_limit: Count  # control periods
    angle_limit: Finite | None  # rad; None: the pole may hang
    x_max: Positive  # m, of (5.4), (6.1), (6.2)


class HardwareTransform(Transform):
    """Counts and motor values of a `Plant` to observations, rewards and scores, and back from actions."""

    def __init__(
        self,
        motors: Sequence[int],
        task: TaskSettings,
        observation: ObservationSettings,
        reward: RewardSettings,
    ) -> None:
        super().__init__()
        self.task, self.observation_settings, self.reward = task, observation, reward
        self.register_buffer("motors", torch.tensor(list(motors), dtype=torch.int64))
        self.register_buffer("_velocity_scales", torch.tensor([SPEED_SCALE, ANGULAR_SPEED_SCALE]))
        self.register_buffer("_kept", torch.tensor(observation.kept_columns, dtype=torch.int64))

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

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action", None)
        if action is not None:
            tensordict.set("motor", self.motors[action].unsqueeze(-1))
        return tensordict

    # frames up

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        counts, dt = tensordict_reset.get("counts"), tensordict_reset.get("dt")
        x, theta = measured_position(counts)
        unknown = torch.zeros_like(x)  # nothing precedes that a velocity could be taken from
        state = torch.stack((x, unknown, theta, unknown), -1)
        past = dt.new_zeros(len(counts), self.observation_settings.past_size)
        tensordict_reset.update(
            {
                "state": state,
                "past": past,
                "observation": self._observe(state, past),
                "score": torch.zeros_like(dt),
                "score_upright": torch.zeros_like(dt),
                "step_count": torch.zeros_like(tensordict_reset.get("motor_applied")),
            }
        )
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        counts, dt = next_tensordict.get("counts"), next_tensordict.get("dt")
        x, theta = measured_position(counts)
        x_dot, theta_dot = measured_velocity(counts, tensordict.get("counts"), dt.squeeze(-1))
        state = torch.stack((x, x_dot, theta, theta_dot), -1)
        past = self._remember(tensordict)
        step_count = tensordict.get("step_count") + 1
        off_track = next_tensordict.get("terminated")
        terminated = off_track | fallen(state, self.task.angle_limit).unsqueeze(-1)
        truncated = next_tensordict.get("truncated") | (step_count >= self.task.time_limit)
        judged = {  # each once: what the agent learns from is often a score
            kind: REWARDS[kind](state, self.task.x_max).unsqueeze(-1)
            for kind in {self.reward.kind, SCORE, SCORE_UPRIGHT}
        }
        reward = self.reward.scale * judged[self.reward.kind]
        next_tensordict.update(
            {
                "state": state,
                "past": past,
                "observation": self._observe(state, past),
                "reward": reward - self.reward.track_penalty * off_track,
                "score": judged[SCORE],
                "score_upright": judged[SCORE_UPRIGHT],
                "step_count": step_count,
                "terminated": terminated,
                "truncated": truncated & ~terminated,
                "done": terminated | truncated,
            }
        )
        return next_tensordict

    def _remember(self, tensordict: TensorDictBase) -> Tensor:
        """`past` one step on."""
        motor = tensordict.get("motor").to(torch.float32) / MOTOR_SCALE
        velocities = tensordict.get("state")[:, 1::2] / self._velocity_scales
        return torch.cat((motor, tensordict.get("past"), velocities), -1).index_select(1, self._kept)

    def _observe(self, state: Tensor, past: Tensor) -> Tensor:
        parts = [observe(state, self.observation_settings.kind), past]
        if self.observation_settings.pole_length:
            parts.append((self.plant.pole_length / LENGTH_SCALE).unsqueeze(-1))
        return torch.cat(parts, -1)
