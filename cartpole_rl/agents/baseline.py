"""A classical controller to compare agents with: energy control swings the pole up, LQR balances it.

Swing-up: Astrom and Furuta, "Swinging up a pendulum by energy control", Automatica 36, 2000: the pivot is
accelerated until the pole has the energy that it has upright. Balance: a discrete linear-quadratic
regulator of the linearized nominal cart (Anderson and Moore, "Optimal control", 1990). Both act on the
predicted state at the time the force takes effect: the measured velocities are half a period old, and the
motor responds after the cart's latency.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are
from tensordict import TensorDictBase
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.dynamics import State, advance, coupling, mechanism
from cartpole_rl.physics.friction import CART_FRICTIONS, viscous_coefficient, viscous_share
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters, cart_column
from cartpole_rl.tasks.features import (
    ANGULAR_SPEED_SCALE,
    MOTOR_SCALE,
    POSITION_SCALE,
    SPEED_SCALE,
    ObservationKind,
)

Array = NDArray[np.float64]
STATE_COST = (10.0, 1.0, 100.0, 1.0)  # LQR weights of x, x_dot, theta, theta_dot squared, SI units
FORCE_COST = 0.05  # 1/N^2, LQR weight of the force squared
SUBSTEPS = 4  # integration steps per linearized period
CATCH_ANGLE = math.radians(35)  # from upright; within it, the regulator takes over if its force suffices
CATCH_FORCE = 1.0  # share of the largest force; the regulator takes over only if it needs less
PUMP_ACCELERATION = 3.8  # m/s^2, of the pivot while the energy is far from its target
PUMP_BAND = 0.1  # of the pole's weight and length: energy error below which the pivot accelerates less
TARGET_ENERGY = 1.06  # of the pole's weight and length; the surplus makes up for friction
CENTRING = (8.0, 1.5)  # m/s^2 per m and per m/s, towards the middle during the swing-up
MARGIN = 0.04  # m, from the track's end: braking stops the cart before it


class EnergyAndRegulator:
    """A policy from `observation` [N, K] to `action` [N]: the motor value whose force is nearest.

    `nominal` holds the parameters of cart and pole. The policy needs measured positions and velocities
    (`kind` raw or cos_sin) and the last motor value (`past_motors` of at least 1); otherwise ConfigError.
    """

    def __init__(
        self,
        nominal: Mapping[str, float],
        models: Models,
        motors: Sequence[int],
        kind: ObservationKind,
        past_motors: int,
        period: float,
    ) -> None:
        if kind is ObservationKind.POSITIONS or past_motors < 1:
            raise ConfigError(
                f"observation.kind={kind}, past_motors={past_motors}: the baseline reads velocities and the "
                "last motor value; set kind to raw or cos_sin, and past_motors to at least 1"
            )
        column = cart_column(nominal)
        self.models, self.kind, self.period = models, kind, period
        self.gain = regulator(column, models, period)
        self.cart = CartParameters(column.float())
        self.body = mechanism(self.cart)
        self.motors = torch.tensor(list(motors), dtype=torch.float32)
        self.forces = models.actuator(self.motors, self.cart)
        self.strongest = float(self.forces.abs().max())

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add `action` [N] and `action_value` [N, A] to `tensordict`."""
        state, motor = decode(tensordict["observation"], self.kind)
        ahead = self.predict(state, motor)
        value = self.value(self.force(ahead), ahead.x_dot)
        return tensordict.set("action_value", value).set("action", value.argmax(-1))

    def predict(self, measured: State, motor: Tensor) -> State:
        """Return the state [N] at which the next motor value takes effect; `motor` [N] acts until then."""
        now = self._after(measured, motor, self.period / 2)._replace(x=measured.x, theta=measured.theta)
        return self._after(now, motor, float(self.cart.latency))

    def _after(self, state: State, motor: Tensor, step: float) -> State:
        force = self.models.actuator(motor, self.cart)
        share = viscous_share(motor, self.cart)
        return advance(state, force, self.cart, self.body, self.models, step, share)

    def force(self, state: State) -> Tensor:
        """Return the control force in `state`, N, [N]."""
        balance = self.balance(state)
        caught = (state.theta.abs() < CATCH_ANGLE) & (balance.abs() < CATCH_FORCE * self.strongest)
        return self.on_track(state, torch.where(caught, balance, self.swing_up(state)))

    def balance(self, state: State) -> Tensor:
        """Return the regulator's force plus compensation of dry friction, N, [N]."""
        force = -sum(float(gain) * value for gain, value in zip(self.gain, state, strict=True))
        return force + self.models.cart_friction(
            state.x_dot + self.period * force / self.cart.driven_mass, self.cart
        )

    def swing_up(self, state: State) -> Tensor:
        """Return the force of the energy controller, N, [N]."""
        lift = self.body.first_moment * GRAVITY  # J per cos(theta)
        kinetic = 0.5 * self.body.pivot_inertia * state.theta_dot**2
        missing = TARGET_ENERGY - torch.cos(state.theta) - kinetic / lift  # of the energy upright, in lifts
        phase = state.theta_dot * torch.cos(state.theta)
        side = torch.where(phase == 0, torch.ones_like(phase), phase.sign())
        pumped = -PUMP_ACCELERATION * (missing / PUMP_BAND).clamp(-1, 1) * side
        target = pumped - CENTRING[0] * state.x - CENTRING[1] * state.x_dot
        return self.force_for(state, target)

    def force_for(self, state: State, x_ddot: Tensor) -> Tensor:
        """Return the force that accelerates the cart by `x_ddot` m/s^2, N, [N], by (3.5), (3.6)."""
        terms = coupling(state, self.cart, self.body)
        moment = self.body.first_moment * terms.cos
        torque = terms.gravity_torque + self.models.pole_friction(state.theta_dot, self.cart)
        theta_ddot = (torque - moment * x_ddot) / self.body.pivot_inertia
        reaction = self.body.felt_moment * (terms.cos * theta_ddot - state.theta_dot**2 * terms.sin)
        viscous = viscous_coefficient(self.cart, self.models.cart_friction) * state.x_dot
        dry = self.models.cart_friction(state.x_dot + self.period * x_ddot, self.cart)
        return self.body.driven_mass * x_ddot + reaction + viscous + dry

    def on_track(self, state: State, force: Tensor) -> Tensor:
        """Return `force` [N], or full braking where the cart would otherwise leave the track."""
        braking = (self.strongest / self.cart.driven_mass).clamp(min=1e-6)
        stop = state.x + state.x_dot * state.x_dot.abs() / (2 * braking)  # m, where it would stop
        end = self.cart.track_half_length - MARGIN
        return torch.where(stop.abs() > end, -stop.sign() * self.strongest, force)

    def value(self, force: Tensor, x_dot: Tensor) -> Tensor:
        """Return the negative distance between each motor value's force and `force`, [N, A].

        `force` is meant for all of the viscous friction, of which a motor that coasts at a small value takes
        away a part. A tie goes to the smallest motor value.
        """
        viscous = viscous_coefficient(self.cart, self.models.cart_friction)
        spared = (1 - viscous_share(self.motors, self.cart)) * viscous * x_dot.unsqueeze(-1)
        return -(force.unsqueeze(-1) - self.forces - spared).abs() - 1e-6 * self.motors.abs()


def decode(observation: Tensor, kind: ObservationKind) -> tuple[State, Tensor]:
    """Return measured state [N] and last motor value [N] of observations [N, K]: inverts `tasks.features`."""
    numbers, motor = observation[:, : kind.size].unbind(-1), observation[:, kind.size] * MOTOR_SCALE
    if kind is ObservationKind.RAW:
        return State(*numbers), motor
    x, x_dot, cosine, sine, theta_dot = numbers[:5]
    theta = torch.atan2(sine, cosine)
    return State(x * POSITION_SCALE, x_dot * SPEED_SCALE, theta, theta_dot * ANGULAR_SPEED_SCALE), motor


def regulator(table: Tensor, models: Models, period: float) -> Array:
    """Return the gain [4], N per m, m/s, rad and rad/s, for the cart `table` [P, 1] float64.

    Raises ConfigError for a cart that no gain balances.
    """
    transition, effect = linearized(table, models, period)
    state_cost, force_cost = np.diag(STATE_COST), np.array([[FORCE_COST]])
    try:
        cost_to_go = solve_discrete_are(transition, effect, state_cost, force_cost)
    except (ValueError, np.linalg.LinAlgError):
        raise ConfigError(
            "run=lqr: no regulator balances this cart; check the masses and frictions of cart and pole"
        ) from None
    gain = np.linalg.solve(force_cost + effect.T @ cost_to_go @ effect, effect.T @ cost_to_go @ transition)
    return gain[0]


def linearized(table: Tensor, models: Models, period: float) -> tuple[Array, Array]:
    """Return (A [4, 4], B [4, 1]) of one period about upright, at constant force, without dry friction."""
    cart = CartParameters(table)
    smooth = CART_FRICTIONS.find("linear" if "cart_viscous" in models.cart_friction.reads else "none")
    body, smooth_models = mechanism(cart), models._replace(cart_friction=smooth)

    def after_a_period(numbers: Tensor) -> Tensor:
        *motion, force = numbers.unsqueeze(-1)
        state = State(*motion)
        for _ in range(SUBSTEPS):
            state = advance(state, force, cart, body, smooth_models, period / SUBSTEPS)
        return torch.cat(state)

    jacobian_matrix = torch.autograd.functional.jacobian(
        after_a_period, torch.zeros(5, dtype=table.dtype)
    ).numpy()
    return jacobian_matrix[:, :4], jacobian_matrix[:, 4:]
