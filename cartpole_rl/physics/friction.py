"""Friction of the cart on its track and of the pole in its bearing: pure functions of the velocity.

The power that each takes out, force or torque times velocity, is never negative. Dry friction is that of the
resting pole's normal force; where the pole's motion changes that force, the dynamics scale it.
"""

import torch
from torch import Tensor

from cartpole_rl.physics.models import CartFriction, PoleFriction
from cartpole_rl.physics.parameters import CartParameters

STICKING = (CartFriction.STEP, CartFriction.STRIBECK)  # models with a force at rest
DRY = (CartFriction.SIGMOID, *STICKING)  # models with more than the viscous term
SLOW_POLE = 0.05  # rad/s, two thirds of a count a period: slower, the bearing's Coulomb friction fades


def coulomb_force(x_dot: Tensor, cart: CartParameters) -> Tensor:
    """Coulomb friction of the direction of motion, N >= 0, [N]."""
    return cart.cart_coulomb * (1 + cart.cart_coulomb_asymmetry * torch.sign(x_dot))


def dry_friction(x_dot: Tensor, cart: CartParameters, model: CartFriction) -> Tensor:
    """Dry friction at the resting pole's normal force, N, [N], with the sign of the velocity.

    Equations (5.6) and (5.8); Stribeck: Armstrong-Helouvry et al., Automatica 30(7), 1994,
    F_c + (F_s - F_c) exp(-(v / v_s)^2).
    """
    if model not in DRY:
        return torch.zeros_like(x_dot)
    coulomb = coulomb_force(x_dot, cart)
    if model is CartFriction.SIGMOID:
        return coulomb * (2 * torch.sigmoid(cart.sigmoid_slope * x_dot) - 1)
    if model is CartFriction.STRIBECK:
        excess = (cart.cart_stiction_ratio - 1) * torch.exp(-((x_dot / cart.stribeck_velocity) ** 2))
        coulomb = coulomb * (1 + excess)
    return coulomb * torch.sign(x_dot)


def viscous_coefficient(cart: CartParameters, model: CartFriction) -> Tensor:
    """N s/m, [N]: equation (5.7), 0 for NONE."""
    return torch.zeros_like(cart.cart_viscous) if model is CartFriction.NONE else cart.cart_viscous


def pole_torque(theta_dot: Tensor, cart: CartParameters, model: PoleFriction) -> Tensor:
    """Friction torque on the pole, N m, [N], against the angular velocity."""
    if model is PoleFriction.NONE:
        return torch.zeros_like(theta_dot)
    torque = -cart.pole_viscous * theta_dot
    if model in (PoleFriction.EXPONENTIAL_DRAG, PoleFriction.BEARING):
        torque = torque - cart.pole_drag * theta_dot * theta_dot.abs()
    if model is PoleFriction.BEARING:
        torque = torque - cart.pole_coulomb * torch.tanh(theta_dot / SLOW_POLE)
    return torque
