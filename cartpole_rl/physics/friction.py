"""Friction laws of the cart on its track and of the pole in its bearing.

The power that each law takes out, force or torque times velocity, is never negative. Dry friction is given
at the normal force of a resting pole; where the pole's motion changes that force, the dynamics scale it.
"""

from typing import TYPE_CHECKING

from cartpole_rl.physics.laws import Law, law_registry, zero
from cartpole_rl.rig.hardware import LARGEST_MOTOR

if TYPE_CHECKING:
    from torch import Tensor

    from cartpole_rl.physics.parameters import CartParameters

# The formula gives dry friction, N, with the sign of the velocity in m/s. A law that reads `cart_viscous` has
# the viscous term (5.7) as well.
CART_FRICTIONS = law_registry("cart_friction")
# The formula gives the torque, N m, against the angular velocity in rad/s.
POLE_FRICTIONS = law_registry("pole_friction")

VISCOUS = ("cart_viscous", "coasting")
COULOMB = (*VISCOUS, "cart_coulomb", "cart_coulomb_asymmetry")
DRAG = ("pole_viscous", "pole_drag")
SLOW_POLE = 0.05  # rad/s, two thirds of a count a period: slower, the bearing's Coulomb friction fades

CART_FRICTIONS.add("none", zero)
CART_FRICTIONS.add("linear", zero, reads=VISCOUS, candidate=True)
POLE_FRICTIONS.add("none", zero)


def coulomb_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Coulomb friction of the direction of motion, N >= 0, [N]."""
    return cart.cart_coulomb * (1 + cart.cart_coulomb_asymmetry * x_dot.sign())


@CART_FRICTIONS.register("sigmoid", reads=(*COULOMB, "sigmoid_slope"), candidate=True)
def sigmoid_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Equation (5.8)."""
    return coulomb_force(x_dot, cart) * (2 * (cart.sigmoid_slope * x_dot).sigmoid() - 1)


@CART_FRICTIONS.register("step", reads=COULOMB, holds_at_rest=True, candidate=True)
def step_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Equation (5.6)."""
    return coulomb_force(x_dot, cart) * x_dot.sign()


@CART_FRICTIONS.register(
    "stribeck",
    reads=(*COULOMB, "cart_stiction_ratio", "stribeck_velocity"),
    holds_at_rest=True,
    candidate=True,
)
def stribeck_force(x_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """F_c + (F_s - F_c) exp(-(v / v_s)^2); Armstrong-Helouvry et al., Automatica 30(7), 1994."""
    excess = (cart.cart_stiction_ratio - 1) * (-((x_dot / cart.stribeck_velocity) ** 2)).exp()
    return coulomb_force(x_dot, cart) * (1 + excess) * x_dot.sign()


@POLE_FRICTIONS.register("exponential", reads=("pole_viscous",))
def viscous_torque(theta_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """A small swing decays exponentially."""
    return -cart.pole_viscous * theta_dot


@POLE_FRICTIONS.register("exponential_drag", reads=DRAG)
def drag_torque(theta_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Viscous friction and quadratic air drag."""
    return viscous_torque(theta_dot, cart) - cart.pole_drag * theta_dot * theta_dot.abs()


@POLE_FRICTIONS.register("bearing", reads=(*DRAG, "pole_coulomb"))
def bearing_torque(theta_dot: "Tensor", cart: "CartParameters") -> "Tensor":
    """Viscous friction, air drag, and the bearing's Coulomb friction."""
    return drag_torque(theta_dot, cart) - cart.pole_coulomb * (theta_dot / SLOW_POLE).tanh()


def viscous_share(motor: "Tensor", cart: "CartParameters") -> "Tensor":
    """Return the share of the viscous friction that is in effect at a motor value, [N].

    With a DC motor most of it is back-EMF. Its current flows all the time if the H-bridge brakes while it is
    off, and in the share |motor| / 255 of the time if it coasts then.
    """
    return 1 - cart.coasting * (1 - motor.abs() / LARGEST_MOTOR)


def viscous_coefficient(cart: "CartParameters", law: Law) -> "Tensor":
    """Return the factor of the viscous term (5.7), N s/m, [N]."""
    return cart.cart_viscous if "cart_viscous" in law.reads else zero(cart.cart_viscous, cart)
