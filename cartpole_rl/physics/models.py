"""The physics models to choose from (friction, actuator, integrator) and the parameters that they ignore.

Settings import this module: it does without PyTorch.
"""

from enum import StrEnum
from typing import NamedTuple

from cartpole_rl.physics.actuator import Actuator
from cartpole_rl.physics.friction import CartFriction, PoleFriction


class Integrator(StrEnum):
    """Explicit Euler (3.7) or semi-implicit Euler (3.8)."""

    EXPLICIT = "explicit"
    SEMI_IMPLICIT = "semi_implicit"


class Models(NamedTuple):
    """The models in force; fixed for a run, so that compiled code has no branches left."""

    cart_friction: CartFriction = CartFriction.SIGMOID
    pole_friction: PoleFriction = PoleFriction.EXPONENTIAL
    actuator: Actuator = Actuator.FORCE_CURVE
    integrator: Integrator = Integrator.SEMI_IMPLICIT
    pole_presses: bool = False  # the pole's vertical force changes the cart's normal force


def unused_parameters(models: Models) -> set[str]:
    """Return the parameters that other friction models or actuators read, and none of `models` does.

    Drawing them changes nothing.
    """
    chosen = (models.cart_friction, models.pole_friction, models.actuator)
    known = {name for choice in chosen for other in type(choice) for name in other.reads}
    return known - {name for choice in chosen for name in choice.reads}
