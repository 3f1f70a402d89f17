"""Friction models of the cart on its track and of the pole in its bearing.

To add a model, add a member to `CartFriction` or `PoleFriction`: its name in settings, the parameters that it
reads, its formula, and whether it holds a cart at rest; and a choice in `conf/`.

The power that each model takes out, force or torque times velocity, is never negative. Dry friction is that
of the resting pole's normal force; where the pole's motion changes that force, the dynamics scale it.
"""

from typing import TYPE_CHECKING

from cartpole_rl.physics.formula import PhysicsModel, zero

if TYPE_CHECKING:
    from torch import Tensor

    from cartpole_rl.physics.parameters import CartParameters

VISCOUS = ("cart_viscous",)
COULOMB = (*VISCOUS, "cart_coulomb", "cart_coulomb_asymmetry")
DRAG = ("pole_viscous", "pole_drag")
SLOW_POLE = 0.05  # rad/s, two thirds of a count a period: slower, the bearing's Coulomb friction fades


def coulomb_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Coulomb friction of the direction of motion, N >= 0, [N]."""
    return cart.cart_coulomb * (1 + cart.cart_coulomb_asymmetry * x_dot.sign())


def step_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Equation (5.6)."""
    return coulomb_force(x_dot, cart) * x_dot.sign()


def sigmoid_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Equation (5.8)."""
    return coulomb_force(x_dot, cart) * (2 * (cart.sigmoid_slope * x_dot).sigmoid() - 1)


def stribeck_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """F_c + (F_s - F_c) exp(-(v / v_s)^2); Armstrong-Helouvry et al., Automatica 30(7), 1994."""
    excess = (cart.cart_stiction_ratio - 1) * (-((x_dot / cart.stribeck_velocity) ** 2)).exp()
    return coulomb_force(x_dot, cart) * (1 + excess) * x_dot.sign()


def viscous_torque(theta_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """A small swing decays exponentially."""
    return -cart.pole_viscous * theta_dot


def drag_torque(theta_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Viscous friction and quadratic air drag."""
    return viscous_torque(theta_dot, cart) - cart.pole_drag * theta_dot * theta_dot.abs()


def bearing_torque(theta_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Viscous friction, air drag, and the bearing's Coulomb friction."""
    return drag_torque(theta_dot, cart) - cart.pole_coulomb * (theta_dot / SLOW_POLE).tanh()


class CartFriction(PhysicsModel):
    """Models of the cart's friction; their formula is that of dry friction, N, with the velocity's sign.

    A model that reads `cart_viscous` also has the viscous term (5.7).
    """

    NONE = "none"
    LINEAR = "linear", VISCOUS
    STEP = "step", COULOMB, step_force, True
    SIGMOID = "sigmoid", (*COULOMB, "sigmoid_slope"), sigmoid_force
    STRIBECK = "stribeck", (*COULOMB, "cart_stiction_ratio", "stribeck_velocity"), stribeck_force, True

    @property
    def has_dry_friction(self) -> bool:
        """The model has more than the viscous term."""
        return self.formula is not zero


class PoleFriction(PhysicsModel):
    """Models of the pole's friction; their formula is that of the torque, N m, against the velocity."""

    NONE = "none"
    EXPONENTIAL = "exponential", ("pole_viscous",), viscous_torque
    EXPONENTIAL_DRAG = "exponential_drag", DRAG, drag_torque
    BEARING = "bearing", (*DRAG, "pole_coulomb"), bearing_torque


def dry_friction(x_dot: "Tensor", cart: "CartParameters", model: CartFriction) -> "Tensor":
    """Return the dry friction at the resting pole's normal force, N, [N], with the sign of the velocity."""
    return model.formula(x_dot, cart)


def viscous_coefficient(cart: "CartParameters", model: CartFriction) -> "Tensor":
    """Return the factor of the viscous term (5.7), N s/m, [N]."""
    return cart.cart_viscous if "cart_viscous" in model.reads else zero(cart.cart_viscous, cart)


def pole_torque(theta_dot: "Tensor", cart: "CartParameters", model: PoleFriction) -> "Tensor":
    """Return the friction torque on the pole, N m, [N], against the angular velocity."""
    return model.formula(theta_dot, cart)
