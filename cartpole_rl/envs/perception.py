"""Pure functions from frames to measured state, memory, observation, reward, scores and endings.

They are the same for simulated and real carts. Every tensor is [k, N], the transpose of the tensordict's, so
that compiled code runs along the carts; `OneCart` makes plain arithmetic for one cart of these functions.
"""

from typing import Generic, NamedTuple

import torch
from torch import Tensor

from cartpole_rl.envs.guard import guard_direction
from cartpole_rl.envs.settings import ObservationSettings, TrackGuard
from cartpole_rl.plants.specs import PlantOutput, Values
from cartpole_rl.rig.hardware import Encoders
from cartpole_rl.tasks.features import (
    ANGULAR_SPEED_SCALE,
    LENGTH_SCALE,
    MOTOR_SCALE,
    SPEED_SCALE,
    Measured,
    ObservationKind,
    measured_position,
    measured_velocity,
    observe,
)
from cartpole_rl.tasks.rewards import SCORE, SCORE_UPRIGHT
from cartpole_rl.tasks.settings import RewardSettings, TaskSettings


class Previous(NamedTuple, Generic[Values]):
    """The step before a frame, and the motor value chosen in it."""

    counts: Values  # [2, N] int64
    state: Values  # [4, N]: x m, x_dot m/s, theta rad, theta_dot rad/s
    past: Values  # [past_size, N]
    speeds: Values  # [speed_periods - 1, N] rad/s of the pole in the steps before, newest first
    step_count: Values  # [1, N] int64
    motor: Values  # [1, N] int64, the value chosen
    length: Values  # [1, N] scaled length of the pole if it is observed, otherwise [0, N]
    track_end: Values  # [1, N] m from the middle


class Percept(NamedTuple, Generic[Values]):
    """Quantities computed from a plant's output; reward, scores and step count are 0 in a first one."""

    state: Values  # [4, N]
    past: Values  # [past_size, N]
    speeds: Values  # [speed_periods - 1, N] rad/s
    observation: Values  # [size, N]
    guard: Values  # [1, N] int64, direction of the track guard's motor value, 0 if the agent's is sent
    reward: Values  # [1, N]
    score: Values  # [1, N] equation (6.2)
    score_upright: Values  # [1, N] equation (6.1)
    step_count: Values  # [1, N] int64
    terminated: Values  # [1, N] bool
    truncated: Values  # [1, N] bool
    done: Values  # [1, N] bool


def perceive_first(
    frame: PlantOutput[Tensor],
    length: Tensor,
    track_end: Tensor,
    *,
    settings: ObservationSettings,
    guard: TrackGuard | None,
    encoders: Encoders,
    speed_periods: int = 1,
) -> Percept[Tensor]:
    """Return the percept of a first frame: velocities and memory are 0."""
    x, theta = measured_position(frame.counts, encoders)
    unknown = torch.zeros_like(x)
    state = Measured(x, unknown, theta, unknown)
    past = x.new_zeros(settings.past_size, len(x))
    nothing = unknown.unsqueeze(0)
    return Percept(
        torch.stack(state),
        past,
        x.new_zeros(speed_periods - 1, len(x)),
        observation(state, past, length, settings),
        guarded(state, track_end, length, guard),
        nothing,
        nothing.clone(),
        nothing.clone(),
        torch.zeros_like(frame.counts[:1]),
        frame.terminated,
        frame.truncated,
        frame.terminated | frame.truncated,
    )


def perceive(
    previous: Previous[Tensor],
    frame: PlantOutput[Tensor],
    *,
    settings: ObservationSettings,
    task: TaskSettings,
    rewards: RewardSettings,
    guard: TrackGuard | None,
    encoders: Encoders,
) -> Percept[Tensor]:
    """Return the percept of the frame after `previous`."""
    x, theta = measured_position(frame.counts, encoders)
    x_dot, theta_dot = measured_velocity(frame.counts, previous.counts, frame.dt[0], encoders)
    state = Measured(x, x_dot, theta, theta_dot)
    past = remember(previous, settings)
    step_count = previous.step_count + 1
    off_track = frame.terminated
    terminated = off_track | fallen(theta, task.angle_limit)
    ended = terminated | frame.truncated | (step_count >= task.periods)
    speeds = torch.cat((theta_dot.unsqueeze(0), previous.speeds))
    judged = state._replace(theta_dot=sum(speeds[1:], start=speeds[0]) / len(speeds))
    values = {  # each once: the reward is often a score
        kind: kind.formula(judged, task.x_max).unsqueeze(0) for kind in {rewards.kind, SCORE, SCORE_UPRIGHT}
    }
    return Percept(
        torch.stack(state),
        past,
        speeds[:-1],
        observation(state, past, previous.length, settings),
        guarded(state, previous.track_end, previous.length, guard),
        rewards.scale * values[rewards.kind] - track_cost(x, off_track, task, rewards),
        values[SCORE],
        values[SCORE_UPRIGHT],
        step_count,
        terminated,
        ended & ~terminated,
        ended,
    )


def fallen(theta: Tensor, angle_limit: float | None) -> Tensor:
    """Return [N] bool: the measured |theta| exceeds `angle_limit` rad; None means no limit."""
    if angle_limit is None:
        return torch.zeros_like(theta, dtype=torch.bool)
    return theta.abs() > angle_limit


def remember(previous: Previous[Tensor], settings: ObservationSettings) -> Tensor:
    """Return the `past` of the next step: motor values, velocities, positions, each newest first."""
    sizes = settings.past_motors, 2 * settings.past_velocities
    motors, velocities, positions = previous.past.split([*sizes, len(previous.past) - sum(sizes)])
    newest = previous.state[1:2] / SPEED_SCALE, previous.state[3:4] / ANGULAR_SPEED_SCALE
    place = torch.stack(observe(Measured(*previous.state), ObservationKind.POSITIONS))
    return torch.cat(
        (
            torch.cat((previous.motor / MOTOR_SCALE, motors))[: len(motors)],
            torch.cat((*newest, velocities))[: len(velocities)],
            torch.cat((place, positions))[: len(positions)],
        )
    )


def observation(state: Measured, past: Tensor, length: Tensor, settings: ObservationSettings) -> Tensor:
    """Return the observation, [size, N]."""
    return torch.cat((torch.stack(observe(state, settings.kind)), past, length))


def guarded(state: Measured, track_end: Tensor, length: Tensor, guard: TrackGuard | None) -> Tensor:
    """Return the direction of the track guard's motor value, int64 [1, N]; 0 without a guard.

    `length` is the scaled length of the pole, [1, N], or [0, N].
    """
    if guard is None:
        return torch.zeros_like(track_end, dtype=torch.int64)
    observed = length[0] * LENGTH_SCALE if len(length) else None
    return guard_direction(state, track_end[0], guard, observed).unsqueeze(0)


def track_cost(x: Tensor, off_track: Tensor, task: TaskSettings, rewards: RewardSettings) -> Tensor:
    """Return the cost of leaving the track and of being near its end, [1, N]."""
    nearness = (x / task.x_max).square().unsqueeze(0)
    return rewards.track_penalty * off_track + rewards.position_cost * nearness
