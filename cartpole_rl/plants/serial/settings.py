"""What can be set about a cart on a port as a plant."""

from typing import Annotated, Literal

from pydantic import Field

from cartpole_rl.plants.serial.cart import SerialSettings
from cartpole_rl.settings import Positive


class SerialPlantSettings(SerialSettings):
    """A cart on a port, and how its episodes begin. Times in s."""

    start: Literal["hanging", "upright"] = "hanging"
    control_period: Positive = 0.02  # set on the cart before an episode, if it has another
    rehome: Literal["once", "always"] = "once"  # once a connection and after what may cost a zero, or always
    home_timeout: Positive = 120.0
    start_timeout: Positive = 60.0  # for the pole to come into its start position
    clear_faults: Annotated[int, Field(ge=0)] | None = 0  # cleared without asking a person; None: no limit
    pole_length: Positive | None = None  # m, twice pivot to centre of mass; for an agent that observes it
