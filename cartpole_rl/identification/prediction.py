"""Predicts encoder counts over windows with the project's own physics, in float64, many carts at once."""

import torch
from torch import Tensor

from cartpole_rl.identification.windows import HISTORY
from cartpole_rl.physics.actuator import lagged_force, mean_commands, static_force
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.models import Actuator, Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT

UNDER_WAY = 4  # motor values that can be: LONGEST_LATENCY is three periods


@torch.no_grad()
def predict(
    table: Tensor,
    motion: Tensor,
    motors: Tensor,
    models: Models,
    period: float,
    substeps: int,
    lead: float = 0.0,
) -> Tensor:
    """Counts [T + 1, 2, N], not rounded, of N carts `table` [P, N] that begin in `motion` [4, N].

    `motors` [HISTORY + T, N] holds the values chosen before the window as well: the actuator runs through
    them first, since its force lags behind. `lead`, s, is added to each latency: (3.8) moves a cart half a
    step early, so that with half a step of it a latency means the same however long the step.
    """
    cart = CartParameters.from_table(table)
    state, force = State(*motion.unbind(0)), torch.zeros_like(motion[0])
    counts = [as_counts(state, cart)]
    for now in range(UNDER_WAY - 1, len(motors)):
        under_way = [motors[now - age] for age in range(UNDER_WAY)]
        if now < HISTORY:
            force = run_actuator(force, under_way, cart, models, period, substeps)
            continue
        state, drive = run_period(
            state, Drive(force, under_way), cart.latency + lead, cart, models, period, substeps
        )
        force = drive.force
        counts.append(as_counts(state, cart))
    return torch.stack(counts)


def run_actuator(
    force: Tensor,
    under_way: list[Tensor],
    cart: CartParameters,
    models: Models,
    period: float,
    substeps: int,
) -> Tensor:
    """The lagged force a period later, N, [N]."""
    if models.actuator is Actuator.NEWTONS:
        return force
    held = [static_force(motor, cart, models.actuator) for motor in under_way]
    for target in mean_commands(held, cart.latency, period, substeps):
        _, force = lagged_force(force, target, cart.motor_time_constant, period / substeps)
    return force


def as_counts(state: State, cart: CartParameters) -> Tensor:
    """What ideal encoders would read, [2, N]."""
    return torch.stack(
        (state.x / CART_METRES_PER_COUNT, (state.theta + cart.angle_offset) / POLE_RADIANS_PER_COUNT)
    )
