"""One control period of N simulated carts as pure functions: a motor value in, encoder counts out.

All that chance has a part in comes in drawn, so that this can be compiled.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.physics.dynamics import Drive, Models, State, run_period
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT


class Cart(NamedTuple):
    """What stays as it is for an episode."""

    table: Tensor  # [P, N], a row a parameter, for `CartParameters.from_table`


class Chance(NamedTuple):
    """Draws for one period, [N] each."""

    latency: Tensor  # uniform in -1 to 1
    position: Tensor  # standard normal, as the next
    angle: Tensor


class Encoders(NamedTuple):
    """What stands between the true state and its counts, [N] each, by the names of CartParameters."""

    angle_offset: Tensor
    position_noise: Tensor
    angle_noise: Tensor


class Command(NamedTuple):
    """What the host sent."""

    motor: Tensor  # [N, 1] int64


class Period(NamedTuple):
    """What a period leads to: State, Drive, and what the cart says."""

    x: Tensor
    x_dot: Tensor
    theta: Tensor
    theta_dot: Tensor
    force: Tensor
    motors: Tensor
    counts: Tensor  # [N, 2] int64
    motor_applied: Tensor  # [N, 1] int64
    off_track: Tensor  # [N, 1] bool

    @property
    def state(self) -> State:
        """The true state at the period's end."""
        return State(self.x, self.x_dot, self.theta, self.theta_dot)

    @property
    def drive(self) -> Drive:
        """The actuator at the period's end."""
        return Drive(self.force, self.motors)


def run_carts(
    state: State,
    drive: Drive,
    command: Command,
    cart: Cart,
    chance: Chance,
    *,
    models: Models,
    period: float,
    substeps: int,
) -> Period:
    """Run every cart for `period` s in `substeps` steps under a new command."""
    parameters = CartParameters.from_table(cart.table)
    motors = torch.cat((command.motor.T.to(drive.motors.dtype), drive.motors[:-1]))
    latency = (parameters.latency + chance.latency * parameters.latency_jitter).clamp(min=0)
    state, drive = run_period(
        state, drive._replace(motors=motors), latency, parameters, models, period, substeps
    )
    return Period(
        *state,
        *drive,
        encoder_counts(state, Encoders(*(getattr(parameters, name) for name in Encoders._fields)), chance),
        motor_in_force(drive.motors, parameters.latency, period),
        (state.x.abs() > parameters.track_half_length).unsqueeze(1),
    )


def encoder_counts(state: State, encoders: Encoders, chance: Chance) -> Tensor:
    """Counts [N, 2] int64 of the true state, with the zero's error and noise."""
    x = state.x + chance.position * encoders.position_noise
    theta = state.theta + encoders.angle_offset + chance.angle * encoders.angle_noise
    return torch.stack((x / CART_METRES_PER_COUNT, theta / POLE_RADIANS_PER_COUNT), 1).round().long()


def motor_in_force(motors: Tensor, latency: Tensor, period: float) -> Tensor:
    """The motor value [N, 1] int64 in force at a period's end, of `motors` [D, N], newest first."""
    applied = motors[0]
    for age in range(1, len(motors)):
        applied = torch.where(latency > age * period, motors[age], applied)
    return applied.unsqueeze(1).long()
