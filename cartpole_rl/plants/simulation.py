"""One control period of N simulated carts as pure functions: a motor value in, encoder counts out.

Random numbers are drawn in advance, so that this can be compiled. Tensors are [N] or [k, N], the
transpose of the tensors in the tensordict: compiled code then runs along the carts.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.physics.dynamics import Drive, MakeAddition, State, run_period
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.rig.hardware import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT

LARGEST_COUNT = 2**30  # STATE's counts are 32-bit numbers


class Carts(NamedTuple):
    """The state before a period, in few tensors: each one costs time in every call."""

    table: Tensor  # [P, N], one row per parameter, for `CartParameters`
    motion: Tensor  # [4, N], the true `State`
    drive: Tensor  # [1 + D, N], the `Drive`: force, then motor values, newest first


class Inputs(NamedTuple):
    """The inputs of a period."""

    motor: Tensor  # [1, N] int64
    noise: Tensor  # [3, N]: of the latency, uniform in -1 to 1; of position and angle, standard normal


class Period(NamedTuple):
    """The results of a period."""

    motion: Tensor  # [4, N]
    drive: Tensor  # [1 + D, N]
    counts: Tensor  # [2, N] int64
    motor_applied: Tensor  # [1, N] int64
    off_track: Tensor  # [1, N] bool


def commands_under_way(delay: float, period: float) -> int:
    """Return how many motor values are under way at most with delays of up to `delay` s."""
    return 1 + max(1, math.ceil(delay / period - 1e-9))


def run_carts(
    carts: Carts,
    inputs: Inputs,
    *,
    models: Models,
    period: float,
    substeps: int,
    addition: MakeAddition | None = None,
) -> Period:
    """Run every cart for `period` s in `substeps` steps under a new motor value."""
    cart = CartParameters(carts.table)
    before = State(*carts.motion.unbind(0))
    force, *motors = carts.drive.unbind(0)
    drive = Drive(force, [inputs.motor[0].to(force.dtype), *motors[:-1]])
    latency = (cart.latency + inputs.noise[0] * cart.latency_jitter).clamp(min=0)
    state, drive = run_period(before, drive, latency, cart, models, period, substeps, addition)
    return Period(
        torch.stack(state),
        torch.stack((drive.force, *drive.motors)),
        encoder_counts(state, cart, inputs.noise),
        motor_in_force(drive.motors, cart.latency, period),
        ~(state.x.abs() <= cart.track_half_length).unsqueeze(0),  # also if it is NaN
    )


def encoder_counts(state: State, cart: CartParameters, noise: Tensor) -> Tensor:
    """Return counts [2, N] int64 of the true state, with the error of the zero and `noise` [3, N]."""
    x = state.x + noise[1] * cart.position_noise
    theta = state.theta + cart.angle_offset + noise[2] * cart.angle_noise
    counts = torch.stack((x / CART_METRES_PER_COUNT, theta / POLE_RADIANS_PER_COUNT)).round()
    return counts.nan_to_num(0.0).clamp(-LARGEST_COUNT, LARGEST_COUNT).long()


def motor_in_force(motors: Sequence[Tensor], latency: Tensor, period: float) -> Tensor:
    """Return the motor value [1, N] int64 in force at a period's end, of `motors` [N] each, newest first."""
    applied = motors[0]
    for age in range(1, len(motors)):
        applied = torch.where(latency > age * period, motors[age], applied)
    return applied.unsqueeze(0).long()
