"""What a host makes of the frames that a cart sends: pure functions, the same for every cart.

Measured state, memory, observation, reward, scores and endings of N carts. Nothing here knows whether a cart
is simulated.
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


class Before(NamedTuple):
    """What the host knew when it chose the motor value that led to a frame."""

    counts: Tensor  # [N, 2] int64
    state: Tensor  # [N, 4]: x m, x_dot m/s, theta rad, theta_dot rad/s
    past: Tensor  # [N, past_size]
    step_count: Tensor  # [N, 1] int64
    motor: Tensor  # [N, 1] int64, the value chosen
    label: Tensor  # [N, 1] scaled length of the pole if the agent observes it, or else [N, 0]


class Frame(NamedTuple):
    """What the plant says after the period: see `plants.specs.Plant`."""

    counts: Tensor  # [N, 2] int64
    dt: Tensor  # [N, 1] s
    terminated: Tensor  # [N, 1] bool
    truncated: Tensor  # [N, 1] bool


class First(NamedTuple):
    """What a host makes of the first frame of an episode."""

    state: Tensor  # [N, 4]
    past: Tensor  # [N, past_size]
    observation: Tensor  # [N, size]
    score: Tensor  # [N, 1], as the next
    score_upright: Tensor
    step_count: Tensor  # [N, 1] int64


class Perceived(NamedTuple):
    """What a host makes of a later frame."""

    state: Tensor  # [N, 4]
    past: Tensor  # [N, past_size]
    observation: Tensor  # [N, size]
    reward: Tensor  # [N, 1]
    score: Tensor  # [N, 1] equation (6.2)
    score_upright: Tensor  # [N, 1] equation (6.1)
    step_count: Tensor  # [N, 1] int64
    terminated: Tensor  # [N, 1] bool
    truncated: Tensor  # [N, 1] bool
    done: Tensor  # [N, 1] bool


def perceive_first(counts: Tensor, label: Tensor, sight: ObservationSettings) -> First:
    """Nothing precedes the first frame that a velocity could be taken from, and nothing is remembered."""
    x, theta = measured_position(counts)
    unknown = torch.zeros_like(x)
    state = Measured(x, unknown, theta, unknown)
    past = x.new_zeros(len(counts), sight.past_size)
    none = unknown.unsqueeze(1)
    return First(
        torch.stack(state, 1),
        past,
        observation(state, past, label, sight),
        score=none,
        score_upright=none.clone(),
        step_count=torch.zeros_like(counts[:, :1]),
    )


def perceive(
    before: Before, frame: Frame, *, sight: ObservationSettings, task: TaskSettings, learned: RewardSettings
) -> Perceived:
    """What the frame that followed means."""
    x, theta = measured_position(frame.counts)
    x_dot, theta_dot = measured_velocity(frame.counts, before.counts, frame.dt.squeeze(1))
    state = Measured(x, x_dot, theta, theta_dot)
    past = remember(before, sight)
    step_count = before.step_count + 1
    off_track = frame.terminated
    terminated = off_track | fallen(state, task.angle_limit).unsqueeze(1)
    ended = terminated | frame.truncated | (step_count >= task.time_limit)
    judged = {  # each once: what the agent learns from is often a score
        kind: REWARDS[kind](state, task.x_max).unsqueeze(1) for kind in {learned.kind, SCORE, SCORE_UPRIGHT}
    }
    return Perceived(
        torch.stack(state, 1),
        past,
        observation(state, past, before.label, sight),
        learned.scale * judged[learned.kind] - learned.track_penalty * off_track,
        judged[SCORE],
        judged[SCORE_UPRIGHT],
        step_count,
        terminated,
        ended & ~terminated,
        ended,
    )


def remember(before: Before, sight: ObservationSettings) -> Tensor:
    """`past` one period on, [N, past_size]: motor values, then pairs of velocities, each newest first."""
    motor = before.motor / MOTOR_SCALE
    velocities = before.state[:, 1::2] / before.state.new_tensor([SPEED_SCALE, ANGULAR_SPEED_SCALE])
    motors, older = before.past.split([sight.past_motors, 2 * sight.past_velocities], 1)
    return torch.cat(
        (
            torch.cat((motor, motors), 1)[:, : sight.past_motors],
            torch.cat((velocities, older), 1)[:, : 2 * sight.past_velocities],
        ),
        1,
    )


def observation(state: Measured, past: Tensor, label: Tensor, sight: ObservationSettings) -> Tensor:
    """What the agent sees, [N, size]."""
    return torch.cat((torch.stack(observe(state, sight.kind), 1), past, label), 1)
