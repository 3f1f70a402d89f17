"""From encoder counts to what an agent sees. All tensors [N] or [N, k] float32; angles rad, positions m."""

from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.physics.encoders import (
    CART_METRES_PER_COUNT,
    POLE_COUNTS_PER_TURN,
    POLE_RADIANS_PER_COUNT,
)
from cartpole_rl.tasks.settings import ObservationKind

# Scales that bring each measured quantity to about one; the velocities' are those of a vigorous swing-up.
POSITION_SCALE = 0.38  # m
SPEED_SCALE = 1.0  # m/s
ANGULAR_SPEED_SCALE = 8.0  # rad/s
MOTOR_SCALE = 255.0
LENGTH_SCALE = 0.5  # m


class Measured(NamedTuple):
    """State of N carts as a host measures it, [N] each."""

    x: Tensor  # m
    x_dot: Tensor  # m/s
    theta: Tensor  # rad, wrapped
    theta_dot: Tensor  # rad/s


def measured_position(counts: Tensor) -> tuple[Tensor, Tensor]:
    """(x m, theta rad) from counts [2, N] int64; theta is wrapped before it loses precision as a float."""
    half_turn = POLE_COUNTS_PER_TURN // 2
    pole = ((counts[1] + half_turn) & (POLE_COUNTS_PER_TURN - 1)) - half_turn  # a turn is a power of two
    return counts[0] * CART_METRES_PER_COUNT, pole * POLE_RADIANS_PER_COUNT


def measured_velocity(counts: Tensor, previous: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
    """(x_dot m/s, theta_dot rad/s): difference of counts [2, N] over `dt` [N] s.

    One count in 20 ms is 1.1 mm/s and 0.077 rad/s; the difference is the velocity half a period ago.
    """
    cart, pole = (counts - previous).to(dt.dtype)
    return cart * CART_METRES_PER_COUNT / dt, pole * POLE_RADIANS_PER_COUNT / dt


def observe(state: Measured, kind: ObservationKind) -> tuple[Tensor, ...]:
    """The numbers of an observation, [N] each: 4 raw, 5 cos/sin or 3 positions."""
    if kind is ObservationKind.RAW:
        return state
    x, cosine, sine = state.x / POSITION_SCALE, torch.cos(state.theta), torch.sin(state.theta)
    if kind is ObservationKind.POSITIONS:
        return x, cosine, sine
    return x, state.x_dot / SPEED_SCALE, cosine, sine, state.theta_dot / ANGULAR_SPEED_SCALE
