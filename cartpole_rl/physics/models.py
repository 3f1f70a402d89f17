"""The physics of a run: one law of each kind (friction, actuator, integrator).

Settings import this module: it does without PyTorch.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.friction import CART_FRICTIONS, POLE_FRICTIONS
from cartpole_rl.physics.laws import Law, law_registry, tried

if TYPE_CHECKING:
    from torch import Tensor

    from cartpole_rl.physics.parameters import CartParameters

# The formula gives the velocity with which a position moves in a step, from those before and after the step.
INTEGRATORS = law_registry("integrator")


@INTEGRATORS.register("explicit")
def explicit(before: "Tensor", after: "Tensor") -> "Tensor":
    """Explicit Euler (3.7)."""
    return before


@INTEGRATORS.register("semi_implicit")
def semi_implicit(before: "Tensor", after: "Tensor") -> "Tensor":
    """Semi-implicit Euler (3.8)."""
    return after


class Models(NamedTuple):
    """The laws in force; fixed for a run, so that compiled code has no branches left."""

    cart_friction: Law = CART_FRICTIONS.find("sigmoid")
    pole_friction: Law = POLE_FRICTIONS.find("exponential")
    actuator: Law = ACTUATORS.find("force_curve")
    integrator: Law = INTEGRATORS.find("semi_implicit")
    pole_presses: bool = False  # the pole's vertical force changes the cart's normal force

    @classmethod
    def of(cls, *, pole_presses: bool = False, **names: str) -> "Models":
        """Return the laws of those names, the defaults for the others. Raises ConfigError."""
        laws: dict[str, Any] = {kind: REGISTRIES[kind].find(name) for kind, name in names.items()}
        return cls(pole_presses=pole_presses)._replace(**laws)


REGISTRIES = {
    "cart_friction": CART_FRICTIONS,
    "pole_friction": POLE_FRICTIONS,
    "actuator": ACTUATORS,
    "integrator": INTEGRATORS,
}


SPEEDS = (-3.0, -0.1, -1e-3, 0.0, 1e-3, 0.1, 3.0)  # m/s or rad/s at which friction is tried


def check_laws(models: Models, cart: "CartParameters") -> None:
    """Raise ConfigError for a law that fails with this one cart, or gives energy to it."""
    speeds = cart.cart_mass.new_tensor(SPEEDS)
    powers = {
        "cart_friction": -tried(models.cart_friction, speeds, cart) * speeds,
        "pole_friction": tried(models.pole_friction, speeds, cart) * speeds,
    }
    for kind, power in powers.items():
        if (power > 0).any():
            speed = speeds[power.argmax()].item()
            raise ConfigError(f"{kind}={getattr(models, kind)} drives at {speed:g}: friction only brakes")
    if (force := tried(models.actuator, 100 * speeds, cart)[len(SPEEDS) // 2]) != 0:
        raise ConfigError(f"actuator={models.actuator} gives {force.item():g} N at motor value 0, not 0")


def unused_parameters(models: Models) -> set[str]:
    """Return the parameters that other laws of these kinds read, and none of `models` does.

    Drawing them changes nothing.
    """
    known = {name for registry in REGISTRIES.values() for law in registry for name in law.reads}
    return known.difference(*(getattr(models, kind).reads for kind in REGISTRIES))
