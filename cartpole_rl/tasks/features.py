"""From encoder counts to what an agent sees. All tensors [N] or [N, k] float32; angles rad, positions m."""

import math
from enum import StrEnum
from typing import NamedTuple

import torch
from torch import Tensor

CART_METRES_PER_COUNT = 2.2749e-5  # Quanser IP02: encoder pinion of 14.83 mm radius, 4096 counts a turn
POLE_COUNTS_PER_TURN = 4096
POLE_RADIANS_PER_COUNT = 2 * math.pi / POLE_COUNTS_PER_TURN

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


class ObservationKind(StrEnum):
    """How the measured state is shown to the agent."""

    RAW = "raw"  # x, x_dot, theta wrapped, theta_dot: the thesis's four numbers
    COS_SIN = "cos_sin"  # x, x_dot, cos theta, sin theta, theta_dot, each scaled to about one
    POSITIONS = "positions"  # x, cos theta, sin theta: as cos_sin, velocities hidden


# What each number of an observation is multiplied by when left and right are swapped.
MIRROR_SIGNS = {
    ObservationKind.RAW: (-1, -1, -1, -1),
    ObservationKind.COS_SIN: (-1, -1, 1, -1, -1),
    ObservationKind.POSITIONS: (-1, 1, -1),
}


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


def observation_size(kind: ObservationKind) -> int:
    """Numbers that `observe` gives."""
    return len(MIRROR_SIGNS[kind])
