"""Settings of the plants: plant=simulated, learned and emulated; plant=serial has its own module."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import INTEGRATORS
from cartpole_rl.plants.serial.settings import Rehome
from cartpole_rl.settings import Fraction, Settings


class SimulatedSettings(Settings):
    """plant=simulated."""

    kind: Literal["simulated"]
    integrator: Annotated[Law, INTEGRATORS]
    substeps: Annotated[int, Field(ge=1, le=200)]
    pole_presses: bool  # the pole's vertical force changes the cart's friction


class LearnedSettings(Settings):
    """plant=learned. The residual of a model is fitted with these physics, so they cannot be chosen."""

    kind: Literal["learned"]
    model: Path
    prior_share: Fraction
    integrator: ClassVar = INTEGRATORS.find("semi_implicit")
    substeps: ClassVar = 4
    pole_presses: ClassVar = False

    @property
    def without_prior(self) -> "LearnedSettings":
        """These settings with carts of the model alone, as an evaluation has them."""
        return self.model_copy(update={"prior_share": 0.0})


class EmulatedSettings(Settings):
    """plant=emulated."""

    kind: Literal["emulated"]
    rehome: Rehome = "once"
