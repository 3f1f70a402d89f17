"""Simulates recorded windows with the project's own physics, many carts at once, and reads their encoders."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from cartpole_rl.identification.unknowns import LONGEST_LATENCY
from cartpole_rl.identification.windows import history_periods
from cartpole_rl.physics.actuator import LAG, lag_shares, mean_commands, step_forces
from cartpole_rl.physics.dynamics import Drive, MakeAddition, State, advance, mechanism, run_period
from cartpole_rl.physics.friction import viscous_share
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.physics.residual import (
    LEAST_MEMORY,
    Residual,
    chosen_members,
    members_in_turn,
    memory_periods,
)


def rollout(
    table: Tensor,
    motion: Tensor,
    motors: Tensor,
    models: Models,
    period: float,
    substeps: int,
    extra_latency: float = 0.0,
    addition: MakeAddition | None = None,
) -> Tensor:
    """Return measured positions [T + 1, 2, N], m, rad, of carts `table` [P, N] from states `motion` [4, N].

    The first `history_periods` of `motors` [H + T, N] are older than the window: the actuator runs through
    them, since its force lags behind. `extra_latency`, s, is added to each latency: (3.8) moves a cart half a
    step early, so a lead of half a step makes latencies independent of the step.
    """
    cart, state = CartParameters(table), State(*motion.unbind(0))
    measured = [as_measured(state, cart)]
    if addition is None:
        body, step = mechanism(cart), period / substeps
        forces = forces_in_steps(cart, motors, models, period, substeps, extra_latency)
        held = viscous_share(motors, cart)
        shares, before = held_in_steps(held, cart.latency + extra_latency, period, substeps)
        for number, (force, share) in enumerate(zip(forces, shares[before:], strict=True), 1):
            state = advance(state, force, cart, body, models, step, share)
            if number % substeps == 0:
                measured.append(as_measured(state, cart))
        return torch.stack(measured)
    latency, force = cart.latency + extra_latency, torch.zeros_like(motion[0])
    history, in_effect = history_periods(period), motors_in_effect(period)
    read = max(in_effect, memory_periods(period))
    for now in range(in_effect - 1, len(motors)):
        reach = in_effect if now < history else read
        drive = Drive(force, [motors[now - age] for age in range(reach)])
        if now < history:
            _, force = step_forces(*drive, latency, cart, models.actuator, period, substeps)
            continue
        state, (force, _) = run_period(
            state, drive, latency, cart, models, period, substeps, addition, in_effect
        )
        measured.append(as_measured(state, cart))
    return torch.stack(measured)


def forces_in_steps(
    cart: CartParameters,
    motors: Tensor,
    models: Models,
    period: float,
    substeps: int,
    extra_latency: float = 0.0,
) -> Tensor:
    """Return the mean force in each of the T x `substeps` steps of a window, N, [T x substeps, N].

    Equals `step_forces`, period by period; `motors` [H + T, N] and `extra_latency` are as in `rollout`.
    """
    law = models.actuator
    targets, before = held_in_steps(law(motors, cart), cart.latency + extra_latency, period, substeps)
    if LAG not in law.reads:
        return targets[before:]
    mean, end = lag_shares(cart.motor_time_constant, period / substeps)
    gaps, force = [], torch.zeros_like(targets[0])
    for target in targets:
        gaps.append(force - target)
        force = target + gaps[-1] * end
    return targets[before:] + torch.stack(gaps[before:]) * mean


def held_in_steps(held: Tensor, latency: Tensor, period: float, substeps: int) -> tuple[Tensor, int]:
    """Return the mean of each step, [S, N], under commands `held` [H + T, N], and the steps of history."""
    in_effect = motors_in_effect(period)
    every = [held[in_effect - 1 - age : len(held) - age] for age in range(in_effect)]
    means = mean_commands(every, latency, period, substeps)
    return torch.stack(means, 1).flatten(0, 1), substeps * (history_periods(period) - in_effect + 1)


def motors_in_effect(period: float) -> int:
    """Return the number of motor values, newest first, that can act on a cart within a control period."""
    return max(LEAST_MEMORY, 1 + math.ceil(LONGEST_LATENCY / period - 1e-9))


def as_measured(state: State, cart: CartParameters) -> Tensor:
    """Return what ideal encoders measure, [2, N], m and rad."""
    return torch.stack((state.x, state.theta + cart.angle_offset))


@dataclass(frozen=True)
class Dynamics:
    """One cart of which copies are simulated."""

    cart: Tensor  # [P, 1] float64
    models: Models
    period: float  # s
    substeps: int
    extra_latency: float = 0.0  # s; see `rollout`

    @classmethod
    def of(
        cls,
        parameters: Mapping[str, float],
        models: Models,
        period: float,
        substeps: int,
        extra_latency: float = 0.0,
    ) -> Self:
        """Return the dynamics of `parameters` by name."""
        return cls(cart_column(parameters), models, period, substeps, extra_latency)

    def positions(self, motion: Tensor, motors: Tensor, residual: Residual | None = None) -> Tensor:
        """Return measured positions [T + 1, 2, M, W] from states [4, M, W] and motor values [H + T, W].

        M is the number of members of `residual`, W that of windows.
        """
        members, windows = motion.shape[1:]
        simulated = rollout(
            self.cart.expand(-1, members * windows),
            motion.reshape(4, -1),
            motors.repeat(1, members),
            self.models,
            self.period,
            self.substeps,
            self.extra_latency,
            None if residual is None else every_member(residual, windows),
        )
        return simulated.reshape(-1, 2, members, windows)


def every_member(residual: Residual, each: int) -> MakeAddition:
    """Return the addition for M times `each` carts, the first member's first, widened."""
    if residual.widening == 1:
        return members_in_turn(residual, each)  # a network runs for its own carts alone
    return chosen_members(residual, torch.arange(residual.members).repeat_interleave(each))
