"""What can be set about an environment: what the agent sees and learns from, what is asked of the cart."""

from pydantic import Field

from cartpole_rl.settings import Count, Finite, NonNegative, Positive, Settings
from cartpole_rl.tasks.settings import MIRROR_SIGNS, ObservationKind, Reward, StartSettings, observation_size

POSITIONS = MIRROR_SIGNS[ObservationKind.POSITIONS]


class ObservationSettings(Settings):
    """What the agent sees beside the present measured state."""

    kind: ObservationKind
    past_motors: int = Field(ge=0, le=16)  # the last so many motor values
    past_velocities: int = Field(ge=0, le=16)  # the velocities so many periods back
    past_positions: int = Field(ge=0, le=16)  # the positions so many periods back, as kind `positions`
    pole_length: bool  # the length of the pole, known from a label on it

    @property
    def past_size(self) -> int:
        """Numbers of the past: motor values, velocities, positions, each newest first."""
        return self.past_motors + 2 * self.past_velocities + len(POSITIONS) * self.past_positions

    @property
    def size(self) -> int:
        """Numbers in an observation."""
        return observation_size(self.kind) + self.past_size + int(self.pole_length)

    @property
    def mirror_signs(self) -> list[int]:
        """What each number of an observation is multiplied by when left and right are swapped, [size]."""
        return [
            *MIRROR_SIGNS[self.kind],
            *[-1] * (self.past_motors + 2 * self.past_velocities),
            *POSITIONS * self.past_positions,
            *[1] * self.pole_length,
        ]

    @property
    def frames(self) -> list[list[int]]:
        """Where in an observation each frame stands, oldest first: its positions, and the motor value before.

        Empty unless positions are what is seen, and each has its motor value.
        """
        if self.kind is not ObservationKind.POSITIONS or self.past_motors <= self.past_positions:
            return []
        size, first = len(POSITIONS), self.size - int(self.pole_length) - len(POSITIONS) * self.past_positions
        places = [0, *range(first, first + size * self.past_positions, size)]  # of x, newest first
        return [[*range(place, place + size), size + age] for age, place in enumerate(places)][::-1]


class RewardSettings(Settings):
    """What the agent learns from: `kind` times `scale`, less what the track costs; scores know no price."""

    kind: Reward
    scale: Positive
    track_penalty: NonNegative  # for leaving the track
    position_cost: NonNegative  # of each step, times (x / x_max)^2: of nearing the track's end


class TaskSettings(Settings):
    """What is asked of the cart."""

    name: str
    start: StartSettings  # where training starts
    evaluation_start: StartSettings
    time_limit: Count  # control periods
    angle_limit: Finite | None  # rad; None: the pole may hang
    x_max: Positive  # m, of (5.4), (6.1), (6.2)
