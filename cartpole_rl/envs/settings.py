"""Settings of the observation and of the track guard."""

from typing import Annotated

from pydantic import Field

from cartpole_rl.settings import NonNegative, Positive, Settings
from cartpole_rl.tasks.features import ObservationKind

POSITIONS = ObservationKind.POSITIONS.mirror_signs
LARGEST_MARGIN = 0.3  # m, of a track guard: most of half a track


class ObservationSettings(Settings):
    """The observation: the measured state and what the agent remembers."""

    kind: ObservationKind
    past_motors: int = Field(ge=0, le=16)  # number of last motor values
    past_velocities: int = Field(ge=0, le=16)  # number of last velocities
    past_positions: int = Field(ge=0, le=16)  # number of last positions, each as kind `positions`
    pole_length: bool  # the length of the pole, as labelled on it

    @property
    def past_size(self) -> int:
        """Size of the past: motor values, velocities, positions, each newest first."""
        return self.past_motors + 2 * self.past_velocities + len(POSITIONS) * self.past_positions

    @property
    def size(self) -> int:
        """Size of an observation."""
        return self.kind.size + self.past_size + int(self.pole_length)

    @property
    def mirror_signs(self) -> list[int]:
        """The factor of each number of an observation when left and right are swapped, [size]."""
        return [
            *self.kind.mirror_signs,
            *[-1] * (self.past_motors + 2 * self.past_velocities),
            *POSITIONS * self.past_positions,
            *[1] * self.pole_length,
        ]

    @property
    def frames(self) -> list[list[int]]:
        """The indices of each frame in an observation, oldest first: its positions and the last motor value.

        Empty unless the kind is `positions` and each position has its motor value.
        """
        if self.kind is not ObservationKind.POSITIONS or self.past_motors <= self.past_positions:
            return []
        size, first = len(POSITIONS), self.size - int(self.pole_length) - len(POSITIONS) * self.past_positions
        places = [0, *range(first, first + size * self.past_positions, size)]  # of x, newest first
        return [[*range(place, place + size), size + age] for age, place in enumerate(places)][::-1]


class TrackGuard(Settings):
    """The numbers of a track guard: see `envs/guard.py`."""

    margin: Annotated[float, Field(ge=0, lt=LARGEST_MARGIN)]  # m
    delay: NonNegative  # s
    deceleration: Positive  # m/s^2

    def at_least(self, other: "TrackGuard") -> "TrackGuard":
        """Return a guard that brakes a cart on its way outward as early as both, or earlier."""
        return TrackGuard(
            margin=max(self.margin, other.margin),
            delay=max(self.delay, other.delay),
            deceleration=min(self.deceleration, other.deceleration),
        )

    def __str__(self) -> str:
        """Return the numbers with their units."""
        return f"margin {self.margin:g} m, delay {self.delay:g} s, deceleration {self.deceleration:g} m/s^2"


class GuardSettings(Settings):
    """The track guard: its numbers, or the quantile by which they are fitted to the carts."""

    enabled: bool
    quantile: Annotated[float, Field(gt=0, le=1)]  # of the ways that braking carts run on
    numbers: TrackGuard | None  # None: fitted when a training starts

    @property
    def active(self) -> TrackGuard | None:
        """The guard to drive with, None if it is disabled or not yet fitted."""
        return self.numbers if self.enabled else None
