"""The hardware transform: encoder counts become observations, actions become motor values.

It is the same over a simulated and a serial plant. It is a single transform, since each TorchRL transform
costs more time than the arithmetic in it. It is stateless: a step depends on the tensordict alone.

Action, key `action` [N] int64:

| value     | meaning                                                    |
|-----------|------------------------------------------------------------|
| 0 to A-1  | index of the motor value (-255 to 255, positive rightward) |
| NO_ACTION | motor 0; the episode is truncated                          |

State, key `state` [N, 4] float32, as measured, without bounds in the specs:

| index | quantity  | unit  | usual range                                                       |
|-------|-----------|-------|-------------------------------------------------------------------|
| 0     | x         | m     | within the track, 0 in the middle, positive right                 |
| 1     | x_dot     | m/s   | -1 to 1 in a swing-up; mean of the last period                    |
| 2     | theta     | rad   | -pi to pi, 0 upright, positive right                              |
| 3     | theta_dot | rad/s | -10 to 10 in a swing-up; mean of the last period                  |

Observation, key `observation` [N, K] float32, in this order (`envs.settings.ObservationSettings`):

| numbers             | quantity                                                                        |
|---------------------|---------------------------------------------------------------------------------|
| 4, 5 or 3           | raw: the state; cos_sin: x, x_dot, cos, sin, theta_dot; positions: x, cos, sin  |
| past_motors         | the last motor values / 255, newest first                                       |
| 2 * past_velocities | the last x_dot, theta_dot                                                       |
| 3 * past_positions  | the last x, cos, sin                                                            |
| 1 if pole_length    | the length of the pole, twice pivot to centre of mass                           |

All but `raw` are divided by the scales in `tasks.features`. Other keys, [N, 1] each: `reward`; the scores of
this step, `score` (6.2) and `score_upright` (6.1); `step_count`; and those of the plant. `past` holds the
numbers that an observation needs from earlier steps, `speeds` those that rewards and scores need.

`terminated`: the cart left the track, or the pole fell (balance). `truncated`: the time limit, a lost link, a
fault that the cart reported, or NO_ACTION. `done` is either; an episode that ends in both ways is terminated.
"""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import Transform

from cartpole_rl.compilation import Compiled
from cartpole_rl.envs.perception import Percept, Previous, perceive, perceive_first
from cartpole_rl.envs.settings import ObservationSettings, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.specs import Plant, PlantOutput, tensordict_of
from cartpole_rl.rig.hardware import Encoders, nominal_encoders
from cartpole_rl.tasks.features import LENGTH_SCALE
from cartpole_rl.tasks.settings import NO_ACTION, RewardSettings, TaskSettings

Perception = Callable[[Previous[Tensor], PlantOutput[Tensor]], Percept[Tensor]]


class HardwareTransform(Transform):
    """The transform over a `Plant`: counts to observations, rewards and scores; actions to motor values."""

    def __init__(
        self,
        motors: Sequence[int],
        task: TaskSettings,
        observation: ObservationSettings,
        reward: RewardSettings,
        guard: TrackGuard | None = None,
        compiled: bool = False,
        encoders: Encoders | None = None,
        speed_periods: int = 1,
    ) -> None:
        """`encoders` are the plant's, ip02's if they are not given; `speed_periods` as in `tasks.rewards`."""
        super().__init__()
        encoders = encoders or nominal_encoders()
        self.task, self.observation_settings, self.reward = task, observation, reward
        self.speed_periods = speed_periods
        self.register_buffer("motors", torch.tensor(list(motors), dtype=torch.int64))
        inward = torch.tensor([0, max(0, *motors), min(0, *motors)])  # by the guard's direction: 0, 1, -1
        self.register_buffer("inward", inward)
        if guard and guard.reads_length and not observation.pole_length:
            raise ConfigError("guard.numbers: the agent does not observe its pole; give pole.length in m")
        self.guard = guard
        self.register_buffer("_by_action", torch.tensor([0, *motors], dtype=torch.int64))  # from NO_ACTION on
        self.first_perception = partial(
            perceive_first, settings=observation, guard=guard, encoders=encoders, speed_periods=speed_periods
        )
        self.perception: Perception = partial(
            perceive, settings=observation, task=task, rewards=reward, guard=guard, encoders=encoders
        )
        self._perceive: Perception = Compiled(self.perception) if compiled else self.perception

    @property
    def plant(self) -> Plant:
        """The plant below."""
        parent = self.parent
        assert parent is not None
        return parent

    # specs

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """Replace `motor` by `action`, an index."""
        motor = action_spec["motor"]
        del action_spec["motor"]
        action_spec["action"] = Categorical(len(self.motors), shape=motor.shape[:1], device=motor.device)
        return action_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the keys that this transform writes."""
        carts, device = observation_spec.shape[0], observation_spec.device
        settings = self.observation_settings
        floats = {"state": 4, "observation": settings.size, "past": settings.past_size}
        floats["speeds"] = self.speed_periods - 1
        for key, size in {**floats, "score": 1, "score_upright": 1}.items():
            observation_spec[key] = Unbounded((carts, size), dtype=torch.float32, device=device)
        observation_spec["guard"] = Bounded(-1, 1, (carts, 1), dtype=torch.int64, device=device)
        observation_spec["step_count"] = Unbounded((carts, 1), dtype=torch.int64, device=device)
        return observation_spec

    # from actions to motor values

    def motor_values(self, action: Tensor) -> Tensor:
        """Return the motor values of actions, int64 of the same shape; 0 for NO_ACTION.

        Raises IndexError for an action that does not exist.
        """
        return self._by_action.index_select(0, action.reshape(-1) - NO_ACTION).reshape(action.shape)

    def command(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the `motor` values [N, 1] to send: those of the actions, or the track guard's."""
        action, guard = tensordict.get("action").unsqueeze(-1), tensordict.get("guard")
        return tensordict_of({"motor": self.sent_motors(action, guard)})

    def sent_motors(self, action: Tensor, guard: Tensor) -> Tensor:
        """Return the motor values to send, int64: those of `action`, or full motor inward under the guard.

        Both have the same shape. NO_ACTION stays 0.
        """
        motor = self.motor_values(action)
        if self.guard is None:
            return motor
        inward = self.inward.index_select(0, guard.reshape(-1) % 3).reshape(guard.shape)
        return torch.where((guard == 0) | (action == NO_ACTION), motor, inward)

    def guarded(self, action: Tensor, guard: Tensor) -> Tensor:
        """Return where the track guard replaces the motor value of `action`, bool; arguments as above."""
        return self.sent_motors(action, guard) != self.motor_values(action)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.update(self.command(tensordict)) if "action" in tensordict else tensordict

    # from frames to observations

    def reset_rows(self, first: TensorDictBase, rows: Tensor | None = None) -> TensorDictBase:
        """Add state and observation to the first frames of the carts `rows` [R]; None means all carts."""
        percept = self.first_perception(output_of(first), self.scaled_length(rows), self.track_end(rows))
        return added(first, percept, without_reward=True)

    def perceive(
        self, current: TensorDictBase, command: TensorDictBase, next_frame: TensorDictBase
    ) -> TensorDictBase:
        """Add state, observation and reward to the frames after a `command` that was chosen on `current`."""
        previous = Previous(
            current.get("counts").T,
            current.get("state").T,
            current.get("past").T,
            current.get("speeds").T,
            current.get("step_count").T,
            command.get("motor").T,
            self.scaled_length(),
            self.track_end(),
        )
        frame = output_of(next_frame)
        frame = frame._replace(truncated=frame.truncated | (current.get("action") == NO_ACTION))
        return added(next_frame, self._perceive(previous, frame))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self.reset_rows(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.perceive(tensordict, tensordict, next_tensordict)

    def scaled_length(self, rows: Tensor | None = None) -> Tensor:
        """Return the scaled pole lengths of the carts `rows`, [1, R]; [0, R] if they are not observed."""
        if not self.observation_settings.pole_length:
            return self.motors.new_empty(
                0, self.plant.carts if rows is None else len(rows), dtype=torch.float32
            )
        lengths = self.plant.pole_length if rows is None else self.plant.pole_length[rows]
        return (lengths / LENGTH_SCALE).unsqueeze(0)

    def track_end(self, rows: Tensor | None = None) -> Tensor:
        """Return where the tracks of the carts `rows` end, m, [1, R]; unbounded without a guard."""
        if self.guard is None:
            carts = self.plant.carts if rows is None else len(rows)
            return torch.full((1, carts), torch.inf, device=self.motors.device)
        ends = self.plant.track_half_length
        return (ends if rows is None else ends[rows]).unsqueeze(0)


def finite_actions(action: Tensor, *numbers: Tensor | None) -> Tensor:
    """Return the actions [N]; NO_ACTION where a row of one of the `numbers` [N, ...] is not finite.

    The argmax of NaN values is the first action, full motor to the left.
    """
    for each in numbers:
        if each is not None:
            action = action.where(each.isfinite().flatten(1).all(1), NO_ACTION)
    return action


def output_of(output: TensorDictBase) -> PlantOutput[Tensor]:
    """Return the frame in the output of a plant."""
    return PlantOutput(*(output.get(key).T for key in PlantOutput._fields))


def added(output: TensorDictBase, percept: Percept[Tensor], without_reward: bool = False) -> TensorDict:
    """Return the output of a plant with the entries of `percept`."""
    entries = dict(output.items()) | {key: rows.T for key, rows in percept._asdict().items()}
    if without_reward:
        del entries["reward"]
    return tensordict_of(entries)
