"""Action sets: the motor values that an agent chooses from, and the simulated actuator."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from cartpole_rl.physics.motor import LARGEST_MOTOR
from cartpole_rl.settings import Settings

NO_ACTION = -1  # where an observation or action value is not finite: motor 0, and the episode ends

MotorValue = Annotated[int, Field(ge=-LARGEST_MOTOR, le=LARGEST_MOTOR)]


class ActionSettings(Settings):
    """Motor values by action index, and the simulated actuator that interprets them."""

    motors: tuple[MotorValue, ...]
    actuator: Literal["newtons", "force_curve"]

    @model_validator(mode="after")
    def _distinct(self) -> "ActionSettings":
        if len(set(self.motors)) != len(self.motors) or len(self.motors) < 2:
            raise ValueError(f"motors {list(self.motors)} must be two or more different values")
        return self
