"""From encoder counts to observations. All tensors are [N] or [k, N]; angles in rad, positions in m."""

from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.physics.encoders import (
    CART_METRES_PER_COUNT,
    POLE_COUNTS_PER_TURN,
    POLE_RADIANS_PER_COUNT,
)
from cartpole_rl.physics.motor import LARGEST_MOTOR
from cartpole_rl.tasks.settings import ObservationKind

# Each scale is about the largest value in a vigorous swing-up.
POSITION_SCALE = 0.38  # m
SPEED_SCALE = 1.0  # m/s
ANGULAR_SPEED_SCALE = 8.0  # rad/s
MOTOR_SCALE = float(LARGEST_MOTOR)
LENGTH_SCALE = 0.5  # m


class Measured(NamedTuple):
    """The measured state of N carts, [N] each."""

    x: Tensor  # m
    x_dot: Tensor  # m/s
    theta: Tensor  # rad, wrapped
    theta_dot: Tensor  # rad/s


def measured_position(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return (x m, theta rad) of counts [2, N] int64; theta is wrapped as an integer, which is exact."""
    half_turn = POLE_COUNTS_PER_TURN // 2
    pole = ((counts[1] + half_turn) & (POLE_COUNTS_PER_TURN - 1)) - half_turn  # a turn is a power of two
    return counts[0] * CART_METRES_PER_COUNT, pole * POLE_RADIANS_PER_COUNT


def measured_velocity(counts: Tensor, previous: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
    """Return (x_dot m/s, theta_dot rad/s): the difference of counts [2, N] divided by `dt` [N] s.

    One count in 20 ms is 1.1 mm/s and 0.077 rad/s. The difference is the velocity half a period earlier.
    """
    cart, pole = (counts - previous).to(dt.dtype)
    return cart * CART_METRES_PER_COUNT / dt, pole * POLE_RADIANS_PER_COUNT / dt


def observe(state: Measured, kind: ObservationKind) -> tuple[Tensor, ...]:
    """Return the numbers of an observation, [N] each: 4 raw, 5 cos/sin or 3 positions."""
    if kind is ObservationKind.RAW:
        return state
    x, cosine, sine = state.x / POSITION_SCALE, torch.cos(state.theta), torch.sin(state.theta)
    if kind is ObservationKind.POSITIONS:
        return x, cosine, sine
    return x, state.x_dot / SPEED_SCALE, cosine, sine, state.theta_dot / ANGULAR_SPEED_SCALE
