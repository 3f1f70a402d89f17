"""Accelerations of cart and pole, equations (3.5) and (3.6), and their integration, (3.7) and (3.8).

theta is the angle of the pole from the vertical, 0 upright, positive to the right; x and forces are positive
to the right. Every tensor is [N]; the four numbers of the state stay separate, which saves stacking and lets
compiled code be fast. Functions are pure: parameters and random draws are passed in.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.physics.actuator import mean_commands, step_forces
from cartpole_rl.physics.friction import viscous_coefficient, viscous_share
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters


class State(NamedTuple):
    """True state of N carts, [N] each: m, m/s, rad, rad/s."""

    x: Tensor
    x_dot: Tensor
    theta: Tensor
    theta_dot: Tensor


class Drive(NamedTuple):
    """The actuator's state, carried from one period to the next."""

    force: Tensor  # [N] N, behind the lag
    motors: Sequence[Tensor]  # [N] motor values of this and the D - 1 periods before, newest first; or [D, N]


class Addition(NamedTuple):
    """Forces and an acceleration on top of the physics during one period, [N] each."""

    force: Tensor  # N on the cart, in front of friction
    force_at: Callable[[Tensor], Tensor]  # position x, m, to a further force on the cart, N
    angular_acceleration: Tensor  # rad/s^2 of the pole


MakeAddition = Callable[[State, Drive], Addition]  # from the state at the start of a period to its addition


class Mechanism(NamedTuple):
    """The constants of (3.5) and (3.6), evaluated once a period, [N] each."""

    driven_mass: Tensor  # kg
    first_moment: Tensor  # m_p l, kg m
    felt_moment: Tensor  # kg m: the share of it that the cart feels
    pivot_inertia: Tensor  # kg m^2
    sin_tilt: Tensor
    cos_tilt: Tensor
    gravity_force: Tensor  # N along a tilted track, as far as it moves the cart
    resting_normal_force: Tensor  # N, of the track on the cart while the pole is at rest


def mechanism(cart: CartParameters) -> Mechanism:
    """Return the constants of a cart."""
    weight = cart.total_mass * GRAVITY
    sin_tilt, cos_tilt = torch.sin(cart.track_tilt), torch.cos(cart.track_tilt)
    return Mechanism(
        cart.driven_mass,
        cart.first_moment,
        cart.backdrivability * cart.first_moment,
        cart.pivot_inertia,
        sin_tilt,
        cos_tilt,
        cart.backdrivability * weight * sin_tilt,
        weight * cos_tilt,
    )


class Coupling(NamedTuple):
    """The terms of (3.5) and (3.6) that change with the angle, [N] each."""

    sin: Tensor  # of the angle from the track's normal
    cos: Tensor
    gravity_torque: Tensor  # N m
    determinant: Tensor  # kg^2 m^2


def coupling(state: State, cart: CartParameters, body: Mechanism) -> Coupling:
    """Return the shared terms. On a track tilted by t the pole stands theta - t from the track's normal."""
    from_normal = state.theta - cart.track_tilt
    sin, cos = torch.sin(from_normal), torch.cos(from_normal)
    sin_theta = sin * body.cos_tilt + cos * body.sin_tilt  # cheaper than a third trigonometric function
    return Coupling(
        sin=sin,
        cos=cos,
        gravity_torque=body.first_moment * GRAVITY * sin_theta,
        determinant=body.driven_mass * body.pivot_inertia - body.felt_moment * body.first_moment * cos**2,
    )


def accelerations(
    state: State, force: Tensor, torque: Tensor, body: Mechanism, terms: Coupling
) -> tuple[Tensor, Tensor]:
    """Return (x_ddot m/s^2, theta_ddot rad/s^2), [N] each, under `force` on cart and `torque` on pole.

    Equations (3.5) and (3.6) for a pole of any inertia: with k = J / (m_p l^2) they are the thesis's. A cart
    with a stepper (`backdrivability` 0) moves as its motor wants, whatever the pole does.
    """
    cart_side = force + body.gravity_force + body.felt_moment * state.theta_dot**2 * terms.sin
    pole_side = terms.gravity_torque + torque
    moment = body.first_moment * terms.cos
    theta_ddot = (body.driven_mass * pole_side - moment * cart_side) / terms.determinant
    x_ddot = (cart_side - body.felt_moment * terms.cos * theta_ddot) / body.driven_mass
    return x_ddot, theta_ddot


def normal_force_ratio(state: State, theta_ddot: Tensor, body: Mechanism, terms: Coupling) -> Tensor:
    """Return the track's normal force over that with the pole at rest, [N], never negative.

    Florian, "Correct equations for the dynamics of the cart-pole system", 2007, equation (22).
    """
    lift = body.first_moment * (theta_ddot * terms.sin + state.theta_dot**2 * terms.cos)
    return (1 - lift / body.resting_normal_force).clamp(min=0)


def speed_lost(
    x_dot: Tensor, x_dot_free: Tensor, yielding: Tensor, cart: CartParameters, friction: Law
) -> Tensor:
    """Return the speed that dry friction takes from the cart in one step, m/s, [N].

    `x_dot_free` m/s is the velocity after the step without dry friction; `yielding`, m/s per N, is the speed
    that a force takes in the step. Laws with a force at rest stop the cart at most and never reverse it:
    the sign of (5.6) is not defined at rest, and taken one step late it feeds energy in.
    """
    if not friction.holds_at_rest:
        return yielding * friction(x_dot, cart)
    toward = torch.copysign(x_dot.abs().clamp(min=torch.finfo(x_dot.dtype).tiny), x_dot_free)
    limit = yielding * friction(toward, cart).abs()
    return x_dot_free.clamp(-limit, limit)


def advance(
    state: State,
    force: Tensor,
    cart: CartParameters,
    body: Mechanism,
    models: Models,
    step: float,
    viscous: Tensor | float = 1.0,
) -> State:
    """Return the state after `step` s under a constant `force` (N, [N]); `body` is `mechanism(cart)`.

    `viscous` is the share of the viscous friction that is in effect.
    """
    terms = coupling(state, cart, body)
    torque = models.pole_friction(state.theta_dot, cart)
    driven = force - viscous * viscous_coefficient(cart, models.cart_friction) * state.x_dot
    x_ddot, theta_ddot = accelerations(state, driven, torque, body, terms)
    x_dot = state.x_dot + step * x_ddot
    theta_dot = state.theta_dot + step * theta_ddot
    if models.cart_friction.has_formula:
        yielding = step * body.pivot_inertia / terms.determinant
        if models.pole_presses:
            yielding = yielding * normal_force_ratio(state, theta_ddot, body, terms)
        lost = speed_lost(state.x_dot, x_dot, yielding, cart, models.cart_friction)
        x_dot = x_dot - lost
        # the pole feels the force through the pivot alone, so that its share follows from (3.5)
        theta_dot = theta_dot + lost * body.first_moment * terms.cos / body.pivot_inertia
    rate, turning = models.integrator(state.x_dot, x_dot), models.integrator(state.theta_dot, theta_dot)
    return State(state.x + step * rate, x_dot, state.theta + step * turning, theta_dot)


def run_period(
    state: State,
    drive: Drive,
    latency: Tensor,
    cart: CartParameters,
    models: Models,
    period: float,
    substeps: int,
    addition: MakeAddition | None = None,
    in_effect: int | None = None,
) -> tuple[State, Drive]:
    """Integrate one control period of `period` s in `substeps` equal steps.

    `drive.motors` holds this period's motor value first; `latency` [N] s is this period's own draw, for all
    pending commands. If the command in force changes inside a step, the step takes the mean of both
    forces by their share of time. `addition` acts in every step; it may read more motor values than the
    newest `in_effect`, which all that `latency` leaves in effect are among.
    """
    step = period / substeps
    body = mechanism(cart)
    added = None if addition is None else addition(state, drive)
    motors = drive.motors[:in_effect]
    forces, last = step_forces(drive.force, motors, latency, cart, models.actuator, period, substeps)
    held = [viscous_share(motor, cart) for motor in motors]
    shares = mean_commands(held, latency, period, substeps)
    for mean, share in zip(forces, shares, strict=True):
        if added is None:
            state = advance(state, mean, cart, body, models, step, share)
        else:
            acting = mean + added.force + added.force_at(state.x)
            state = advance(state, acting, cart, body, models, step, share)
            state = turned(state, added.angular_acceleration, step)
    return state, Drive(last, drive.motors)


def turned(state: State, acceleration: Tensor, step: float) -> State:
    """Return the state after a further angular acceleration, rad/s^2, [N], for `step` s."""
    faster = step * acceleration
    return state._replace(theta=state.theta + step * faster, theta_dot=state.theta_dot + faster)
