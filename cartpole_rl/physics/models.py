"""The laws that a cart obeys (friction models, actuator, integrator), and the parameters that they ignore."""

from enum import StrEnum
from typing import NamedTuple

SHAPES = ("cart_stiction_ratio", "stribeck_velocity", "sigmoid_slope")  # of the dry friction's curve


class CartFriction(StrEnum):
    """Model of the cart's friction. All but NONE add the viscous term."""

    NONE = "none"
    LINEAR = "linear"  # (5.7): viscous alone
    STEP = "step"  # (5.6)
    SIGMOID = "sigmoid"  # (5.8)
    STRIBECK = "stribeck"  # static friction above Coulomb, falling with speed


class PoleFriction(StrEnum):
    """Model of the pole's friction."""

    NONE = "none"
    EXPONENTIAL = "exponential"  # viscous: a small swing decays exponentially
    EXPONENTIAL_DRAG = "exponential_drag"  # viscous and quadratic air drag
    BEARING = "bearing"  # viscous, air drag, and the bearing's Coulomb friction


class Actuator(StrEnum):
    """How a motor value becomes a force."""

    NEWTONS = "newtons"  # exactly, without lag, dead-band or asymmetry, whatever the cart's own are
    FORCE_CURVE = "force_curve"


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


UNUSED_BY_CART_FRICTION = {
    CartFriction.NONE: {"cart_viscous", "cart_coulomb", "cart_coulomb_asymmetry", *SHAPES},
    CartFriction.LINEAR: {"cart_coulomb", "cart_coulomb_asymmetry", *SHAPES},
    CartFriction.STEP: set(SHAPES),
    CartFriction.SIGMOID: {"cart_stiction_ratio", "stribeck_velocity"},
    CartFriction.STRIBECK: {"sigmoid_slope"},
}
UNUSED_BY_POLE_FRICTION = {
    PoleFriction.NONE: {"pole_viscous", "pole_drag", "pole_coulomb"},
    PoleFriction.EXPONENTIAL: {"pole_drag", "pole_coulomb"},
    PoleFriction.EXPONENTIAL_DRAG: {"pole_coulomb"},
    PoleFriction.BEARING: set(),
}
UNUSED_BY_ACTUATOR = {
    Actuator.NEWTONS: {
        "force_quadratic",
        "force_linear",
        "force_offset",
        "force_asymmetry",
        "deadband_left",
        "deadband_right",
        "motor_time_constant",
    },
    Actuator.FORCE_CURVE: set(),
}


def unused_parameters(models: Models) -> set[str]:
    """Fields of CartParameters that these laws do not read, so that drawing them changes nothing."""
    return (
        UNUSED_BY_CART_FRICTION[models.cart_friction]
        | UNUSED_BY_POLE_FRICTION[models.pole_friction]
        | UNUSED_BY_ACTUATOR[models.actuator]
    )
