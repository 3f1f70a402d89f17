"""Accelerations of cart and pole, equations (3.5) and (3.6), and their integration, (3.7) and (3.8).

theta is the angle of the pole from the vertical, 0 upright, positive to the right; x and forces are positive to
the right. Every tensor is [N]; the four numbers of the state stay separate, which is what makes the compiled
code fast. Functions are pure: parameters and random draws are passed in.
"""

from enum import StrEnum
from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.physics.actuator import Actuator, in_force_share, lagged_force, static_force
from cartpole_rl.physics.friction import (
    STICKING,
    CartFriction,
    PoleFriction,
    coulomb_force,
    dry_friction,
    pole_torque,
    viscous_coefficient,
)
from cartpole_rl.physics.parameters import GRAVITY, CartParameters


class State(NamedTuple):
    """True state of N carts, [N] each: m, m/s, rad, rad/s."""

    x: Tensor
    x_dot: Tensor
    theta: Tensor
    theta_dot: Tensor


class Drive(NamedTuple):
    """What the actuator carries from one period to the next."""

    force: Tensor  # [N] N, behind the lag
    motors: Tensor  # [N, D] motor values of this and the D - 1 periods before, newest first


class Integrator(StrEnum):
    """Explicit Euler (3.7) or semi-implicit Euler (3.8)."""

    EXPLICIT = "explicit"
    SEMI_IMPLICIT = "semi_implicit"


class Models(NamedTuple):
    """Which laws hold; fixed for a run, so that compiled code has no branches left."""

    cart_friction: CartFriction = CartFriction.SIGMOID
    pole_friction: PoleFriction = PoleFriction.EXPONENTIAL
    actuator: Actuator = Actuator.FORCE_CURVE
    integrator: Integrator = Integrator.SEMI_IMPLICIT
    pole_presses: bool = False  # the pole's vertical force changes the cart's normal force


class Coupling(NamedTuple):
    """The terms of (3.5) and (3.6) that both equations and the friction share, [N] each."""

    sin: Tensor  # of the angle from the track's normal
    cos: Tensor
    gravity_torque: Tensor  # N m
    gravity_force: Tensor  # N along a tilted track
    determinant: Tensor  # kg^2 m^2


def coupling(state: State, cart: CartParameters) -> Coupling:
    """Evaluate the shared terms. On a track tilted by t the pole stands theta - t from the track's normal."""
    sin, cos = torch.sin(state.theta), torch.cos(state.theta)
    sin_tilt, cos_tilt = torch.sin(cart.track_tilt), torch.cos(cart.track_tilt)
    cos_normal = cos * cos_tilt + sin * sin_tilt
    return Coupling(
        sin=sin * cos_tilt - cos * sin_tilt,
        cos=cos_normal,
        gravity_torque=cart.first_moment * GRAVITY * sin,
        gravity_force=cart.total_mass * GRAVITY * sin_tilt,
        determinant=cart.total_mass * cart.pivot_inertia - (cart.first_moment * cos_normal) ** 2,
    )


def accelerations(
    state: State, force: Tensor, torque: Tensor, cart: CartParameters, terms: Coupling
) -> tuple[Tensor, Tensor]:
    """(x_ddot m/s^2, theta_ddot rad/s^2), [N] each, under `force` on the cart and `torque` on the pole.

    Equations (3.5) and (3.6) for a pole of any inertia: with k = J / (m_p l^2) they are the thesis's.
    """
    cart_side = force + terms.gravity_force + cart.first_moment * state.theta_dot**2 * terms.sin
    pole_side = terms.gravity_torque + torque
    theta_ddot = (
        cart.total_mass * pole_side - cart.first_moment * terms.cos * cart_side
    ) / terms.determinant
    x_ddot = (cart_side - cart.first_moment * terms.cos * theta_ddot) / cart.total_mass
    return x_ddot, theta_ddot


def normal_force_ratio(state: State, theta_ddot: Tensor, cart: CartParameters, terms: Coupling) -> Tensor:
    """Normal force of the track over that with the pole at rest, [N], never negative.

    Florian, "Correct equations for the dynamics of the cart-pole system", 2007, equation (22).
    """
    lift = cart.first_moment * (theta_ddot * terms.sin + state.theta_dot**2 * terms.cos)
    return (1 - lift / (cart.total_mass * GRAVITY)).clamp(min=0)


def friction_force(
    state: State,
    free: tuple[Tensor, Tensor],
    cart: CartParameters,
    models: Models,
    step: float,
    terms: Coupling,
) -> Tensor:
    """Dry friction on the cart over one step, N, [N], to be subtracted from the force.

    `free`: the accelerations without it. Models with a force at rest stop the cart within the step at most,
    never push it back: the sign of (5.6) is not defined at rest, and taken one step late it feeds energy in.
    """
    x_ddot, theta_ddot = free
    pressing = (
        normal_force_ratio(state, theta_ddot, cart, terms) if models.pole_presses else torch.ones_like(x_ddot)
    )
    if models.cart_friction not in STICKING:
        return pressing * dry_friction(state.x_dot, cart, models.cart_friction)
    x_dot_free = state.x_dot + step * x_ddot
    stopping = x_dot_free * terms.determinant / (step * cart.pivot_inertia)
    limit = pressing * sticking_limit(state.x_dot, x_dot_free, cart, models.cart_friction)
    return torch.minimum(torch.maximum(stopping, -limit), limit)


def sticking_limit(x_dot: Tensor, x_dot_free: Tensor, cart: CartParameters, model: CartFriction) -> Tensor:
    """Largest dry friction, N >= 0, [N]: the law at this speed, in the direction the cart is about to move."""
    toward = torch.copysign(x_dot.abs().clamp(min=torch.finfo(x_dot.dtype).tiny), x_dot_free)
    law = dry_friction(toward, cart, model).abs()
    return torch.where(x_dot_free == 0, coulomb_force(x_dot_free, cart), law)


def advance(state: State, force: Tensor, cart: CartParameters, models: Models, step: float) -> State:
    """The state after `step` s under a constant `force` (N, [N]) of the motor."""
    terms = coupling(state, cart)
    torque = pole_torque(state.theta_dot, cart, models.pole_friction)
    driven = force - viscous_coefficient(cart, models.cart_friction) * state.x_dot
    free = accelerations(state, driven, torque, cart, terms)
    if models.cart_friction in (CartFriction.NONE, CartFriction.LINEAR):
        x_ddot, theta_ddot = free
    else:
        friction = friction_force(state, free, cart, models, step, terms)
        # (3.5) and (3.6) are linear in the force, so only its share is added
        x_ddot = free[0] - friction * cart.pivot_inertia / terms.determinant
        theta_ddot = free[1] + friction * cart.first_moment * terms.cos / terms.determinant
    x_dot = state.x_dot + step * x_ddot
    theta_dot = state.theta_dot + step * theta_ddot
    if models.integrator is Integrator.EXPLICIT:
        return State(state.x + step * state.x_dot, x_dot, state.theta + step * state.theta_dot, theta_dot)
    return State(state.x + step * x_dot, x_dot, state.theta + step * theta_dot, theta_dot)


def run_period(
    state: State,
    drive: Drive,
    latency: Tensor,
    cart: CartParameters,
    models: Models,
    period: float,
    substeps: int,
) -> tuple[State, Drive]:
    """One control period of `period` s in `substeps` equal steps.

    `drive.motors` holds this period's motor value first; `latency` [N] s is this period's own draw. Where the
    command in force changes inside a step, the step takes the mean of both forces by their share of time.
    """
    step = period / substeps
    targets = [static_force(motor, cart, models.actuator) for motor in drive.motors.unbind(-1)]
    force = drive.force
    ideal = models.actuator is Actuator.NEWTONS
    for index in range(substeps):
        target = sum(
            in_force_share(latency, age, index * step, step, period) * held for age, held in enumerate(targets)
        )
        mean, force = (target, target) if ideal else lagged_force(force, target, cart.motor_time_constant, step)
        state = advance(state, mean, cart, models, step)
    return state, Drive(force, drive.motors)


def energy(state: State, cart: CartParameters) -> Tensor:
    """Kinetic and potential energy, J, [N]; 0 for a cart at rest in the middle with the pole level."""
    angle = state.theta - cart.track_tilt
    kinetic = (
        0.5 * cart.total_mass * state.x_dot**2
        + cart.first_moment * state.x_dot * state.theta_dot * torch.cos(angle)
        + 0.5 * cart.pivot_inertia * state.theta_dot**2
    )
    height = cart.first_moment * GRAVITY * torch.cos(state.theta)
    slope = -cart.total_mass * GRAVITY * state.x * torch.sin(cart.track_tilt)
    return kinetic + height + slope
