"""Friction over velocity and force over motor value of an identified cart, with their uncertainty."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.physics.friction import viscous_coefficient
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.rig.hardware import LARGEST_MOTOR

FASTEST = 0.6  # m/s
MOST_SAMPLES = 500  # carts in a band

Array = NDArray[np.floating]
Parameters = Mapping[str, float]


class Curve(NamedTuple):
    """A curve at S places: of the identified cart, of N carts from the posterior, and of the prior."""

    at: Array  # [S]
    identified: Array  # [S]
    samples: Array  # [S, N]
    prior: Array  # [S]


def friction_curve(identified: Parameters, samples: Array, prior: Parameters, law: Law) -> Curve:
    """Return the cart's friction (N) over its velocity (m/s): figures 5.2 and 5.3 of the thesis.

    `samples` [P, N] are carts drawn from the posterior, a row each of `CartParameters.names()`.
    """
    velocity = torch.linspace(-FASTEST, FASTEST, 241, dtype=torch.float64)

    def friction(cart: CartParameters) -> torch.Tensor:
        moving = velocity[:, None]
        return law(moving, cart) + viscous_coefficient(cart, law) * moving

    return _curve(velocity, friction, identified, samples, prior)


def force_curve(identified: Parameters, samples: Array, prior: Parameters, actuator: Law) -> Curve:
    """Return the force (N) over the motor value: figure 5.5 of the thesis; see `friction_curve`."""
    motor = torch.arange(-LARGEST_MOTOR, LARGEST_MOTOR + 1, dtype=torch.float64)

    def force(cart: CartParameters) -> torch.Tensor:
        return actuator(motor[:, None], cart)

    return _curve(motor, force, identified, samples, prior)


def _curve(
    at: torch.Tensor,
    function: Callable[[CartParameters], torch.Tensor],
    identified: Parameters,
    samples: Array,
    prior: Parameters,
) -> Curve:
    def of_table(table: torch.Tensor) -> Array:
        return function(CartParameters(table[:, None])).numpy()

    def of_cart(cart: Parameters) -> Array:
        return of_table(cart_column(cart))[:, 0]

    band = of_table(torch.from_numpy(samples[:, :MOST_SAMPLES]))
    return Curve(at.numpy(), of_cart(identified), band, of_cart(prior))
