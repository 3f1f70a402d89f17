"""What a host makes of the frames that a cart sends: pure functions, the same for every cart.

Measured state, memory, observation, reward, scores and endings of N carts. Nothing here knows whether a cart
is simulated. Every tensor is [k, N], a row a number, which is the transpose of what stands in the tensordict:
compiled code then runs along the carts.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.envs.settings import ObservationSettings, RewardSettings, TaskSettings
from cartpole_rl.tasks.endings import fallen
from cartpole_rl.tasks.features import (
    ANGULAR_SPEED_SCALE,
    MOTOR_SCALE,
    SPEED_SCALE,
    Measured,
    measured_position,
    measured_velocity,
    observe,
)
from cartpole_rl.tasks.rewards import REWARDS, SCORE, SCORE_UPRIGHT
from cartpole_rl.tasks.settings import ObservationKind


class Before(NamedTuple):
    """What the host knew when it chose the motor value that led to a frame."""

    counts: Tensor  # [2, N] int64
    state: Tensor  # [4, N]: x m, x_dot m/s, theta rad, theta_dot rad/s
    past: Tensor  # [past_size, N]
    step_count: Tensor  # [1, N] int64
    motor: Tensor  # [1, N] int64, the value chosen
    label: Tensor  # [1, N] scaled length of the pole if the agent observes it, or else [0, N]


class Frame(NamedTuple):
    """What the plant says after the period: see `plants.specs.Plant`."""

    counts: Tensor  # [2, N] int64
    dt: Tensor  # [1, N] s
    terminated: Tensor  # [1, N] bool
    truncated: Tensor  # [1, N] bool


class First(NamedTuple):
    """What a host makes of the first frame of an episode."""

    state: Tensor  # [4, N]
    past: Tensor  # [past_size, N]
    observation: Tensor  # [size, N]
    score: Tensor  # [1, N], as the next
    score_upright: Tensor
    step_count: Tensor  # [1, N] int64


class Perceived(NamedTuple):
    """What a host makes of a later frame."""

    state: Tensor  # [4, N]
    past: Tensor  # [past_size, N]
    observation: Tensor  # [size, N]
    reward: Tensor  # [1, N]
    score: Tensor  # [1, N] equation (6.2)
    score_upright: Tensor  # [1, N] equation (6.1)
    step_count: Tensor  # [1, N] int64
    terminated: Tensor  # [1, N] bool
    truncated: Tensor  # [1, N] bool
    done: Tensor  # [1, N] bool


def perceive_first(counts: Tensor, label: Tensor, settings: ObservationSettings) -> First:
    """Nothing precedes the first frame that a velocity could be taken from, and nothing is remembered."""
    x, theta = measured_position(counts)
    unknown = torch.zeros_like(x)
    state = Measured(x, unknown, theta, unknown)
    past = x.new_zeros(settings.past_size, len(x))
    nothing = unknown.unsqueeze(0)
    return First(
        torch.stack(state),
        past,
        observation(state, past, label, settings),
        score=nothing,
        score_upright=nothing.clone(),
        step_count=torch.zeros_like(counts[:1]),
    )


def perceive(
    before: Before,
    frame: Frame,
    *,
    settings: ObservationSettings,
    task: TaskSettings,
    rewards: RewardSettings,
) -> Perceived:
    """What the frame that followed means."""
    x, theta = measured_position(frame.counts)
    x_dot, theta_dot = measured_velocity(frame.counts, before.counts, frame.dt[0])
    state = Measured(x, x_dot, theta, theta_dot)
    past = remember(before, settings)
    step_count = before.step_count + 1
    off_track = frame.terminated
    terminated = off_track | fallen(state, task.angle_limit)
    ended = terminated | frame.truncated | (step_count >= task.time_limit)
    judged = {  # each once: what the agent learns from is often a score
        kind: REWARDS[kind](state, task.x_max).unsqueeze(0) for kind in {rewards.kind, SCORE, SCORE_UPRIGHT}
    }
    return Perceived(
        torch.stack(state),
        past,
        observation(state, past, before.label, settings),
        rewards.scale * judged[rewards.kind] - track_cost(x, off_track, task, rewards),
        judged[SCORE],
        judged[SCORE_UPRIGHT],
        step_count,
        terminated,
        ended & ~terminated,
        ended,
    )


def remember(before: Before, settings: ObservationSettings) -> Tensor:
    """`past` one period on, [past_size, N]: motor values, velocities, positions, each newest first."""
    sizes = settings.past_motors, 2 * settings.past_velocities
    motors, velocities, positions = before.past.split([*sizes, len(before.past) - sum(sizes)])
    newest = before.state[1:2] / SPEED_SCALE, before.state[3:4] / ANGULAR_SPEED_SCALE
    place = torch.stack(observe(Measured(*before.state), ObservationKind.POSITIONS))
    return torch.cat(
        (
            torch.cat((before.motor / MOTOR_SCALE, motors))[: len(motors)],
            torch.cat((*newest, velocities))[: len(velocities)],
            torch.cat((place, positions))[: len(positions)],
        )
    )


def observation(state: Measured, past: Tensor, label: Tensor, settings: ObservationSettings) -> Tensor:
    """What the agent sees, [size, N]."""
    return torch.cat((torch.stack(observe(state, settings.kind)), past, label))


def track_cost(x: Tensor, off_track: Tensor, task: TaskSettings, rewards: RewardSettings) -> Tensor:
    """What nearing and leaving the track's end take off the reward, [1, N]."""
    nearness = (x / task.x_max).square().unsqueeze(0)
    return rewards.track_penalty * off_track + rewards.position_cost * nearness
