"""Settings of a task: actions, starts, rewards."""

import math
from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.laws import Law
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.settings import Finite, Fraction, NonNegative, Positive, Settings
from cartpole_rl.tasks.rewards import Reward

Measure = Literal["score", "score_upright"]  # equations (6.2) and (6.1), as in metrics.json
CENTRED = 0.01  # m: homing leaves a cart about so near the middle
NO_ACTION = -1  # where an observation or action value is not finite: motor 0, and the episode ends

MotorValue = Annotated[int, Field(ge=-LARGEST_MOTOR, le=LARGEST_MOTOR)]


class ActionSettings(Settings):
    """Motor values by action index, and the simulated actuator that interprets them."""

    motors: tuple[MotorValue, ...]
    actuator: Annotated[Law, ACTUATORS]

    @model_validator(mode="after")
    def _distinct(self) -> "ActionSettings":
        if len(set(self.motors)) != len(self.motors) or len(self.motors) < 2:
            raise ValueError(f"motors {list(self.motors)} must be two or more different values")
        return self


class Start(StrEnum):
    """The initial angle of the pole."""

    UPRIGHT = "upright"
    HANGING = "hanging"
    ANY = "any"  # uniform in (-180, 180] degrees


class StartSettings(Settings):
    """The initial state of an episode, drawn uniformly within plus or minus each spread."""

    angle: Start
    position_spread: NonNegative  # m, of the cart about the middle; less on a short track
    angle_spread: NonNegative  # rad, about upright or hanging
    speed_spread: NonNegative  # m/s
    angular_speed_spread: NonNegative  # rad/s
    resting_share: Fraction = 0.0  # of the episodes start with a hanging pole at rest
    centred_share: Fraction = 0.0  # of these start within CENTRED of the middle, as after homing

    @property
    def farthest(self) -> tuple[str, float]:
        """The setting that lets episodes start farthest from upright, with its value, and how far, rad."""
        if self.angle is not Start.UPRIGHT:
            return f"angle={self.angle}", math.pi
        if self.resting_share:
            return f"resting_share={self.resting_share:g}", math.pi
        return f"angle_spread={self.angle_spread:g}", min(self.angle_spread, math.pi)


class RewardSettings(Settings):
    """The reward: `kind` times `scale`, minus the costs of the track, which the scores do not have."""

    kind: Reward
    scale: Positive
    track_penalty: NonNegative  # for leaving the track
    position_cost: NonNegative  # of each step, times (x / x_max)^2
    period: Positive | None = None  # s that `scale` and `position_cost` are for; None: any control period

    def at(self, control_period: float) -> Self:
        """Return the reward with the same sum over a second, for steps of a control period in s."""
        if self.period is None:
            return self
        share = control_period / self.period
        scaled = {"scale": share * self.scale, "position_cost": share * self.position_cost}
        return self.model_copy(update={**scaled, "period": None})


LONGEST_EPISODE = 86_400.0  # s
MOST_PERIODS = 20_000_000  # of an episode


def within_half_turn(angle: float) -> float:
    """Return `angle`, rad, if it is above 0 and at most pi. Raises ValueError."""
    if not 0 < angle <= math.pi:
        meant = f"{angle:g} degrees are {math.radians(angle):.4g}" if 0 < angle <= 180 else "or null"
        raise ValueError(f"give rad, above 0 and at most pi; {meant}")
    return angle


class TaskSettings(Settings):
    """The task."""

    name: str
    start: StartSettings  # of training episodes
    evaluation_start: StartSettings
    # s, of an episode; missing in checkpoints of earlier versions
    duration: Annotated[float, Field(gt=0, le=LONGEST_EPISODE)] | None = None
    # or its length in control periods, which takes precedence
    time_limit: Annotated[int, Field(ge=1, le=MOST_PERIODS)] | None = None
    angle_limit: Annotated[Finite, AfterValidator(within_half_turn)] | None  # rad; None: the pole may hang
    x_max: Positive  # m, of (5.4), (6.1), (6.2)

    @model_validator(mode="after")
    def _has_an_end(self) -> Self:
        if self.duration is None and self.time_limit is None:
            raise ValueError("give duration (s), or time_limit (control periods)")
        return self

    def check_starts(self) -> None:
        """Raise ConfigError if episodes of a new training would end as they start."""
        if self.angle_limit is None:
            return
        for name, start in (("start", self.start), ("evaluation_start", self.evaluation_start)):
            setting, angle = start.farthest
            if angle > self.angle_limit:
                raise ConfigError(
                    f"task.{name}.{setting}: episodes would start up to {angle:.3g} rad from upright, and "
                    f"end at once beyond task.angle_limit={self.angle_limit:.3g}; give start angles within "
                    "it, or task.angle_limit=null"
                )

    @property
    def periods(self) -> int:
        """The length of an episode in control periods; `at` sets it where only seconds are given."""
        assert self.time_limit is not None
        return self.time_limit

    def at(self, control_period: float) -> Self:
        """Return the task with its `time_limit`, for a control period in s."""
        if self.time_limit is not None:
            return self
        assert self.duration is not None
        return self.model_copy(update={"time_limit": max(1, round(self.duration / control_period))})

    @property
    def measure(self) -> Measure:
        """The score that judges an agent: (6.1) where the pole must not fall, (6.2) elsewhere (section 6)."""
        return "score" if self.angle_limit is None else "score_upright"
