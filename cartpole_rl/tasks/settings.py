"""Choices of a task: starts, observations, rewards."""

from enum import StrEnum

from cartpole_rl.settings import Fraction, NonNegative, Settings


class Start(StrEnum):
    """The initial angle of the pole."""

    UPRIGHT = "upright"
    HANGING = "hanging"
    ANY = "any"  # uniform in (-180, 180] degrees


class StartSettings(Settings):
    """The initial state of an episode, drawn uniformly within plus or minus each spread."""

    angle: Start
    position_spread: NonNegative  # m, of the cart about the middle
    angle_spread: NonNegative  # rad, about upright or hanging
    speed_spread: NonNegative  # m/s
    angular_speed_spread: NonNegative  # rad/s
    resting_share: Fraction = 0.0  # of the episodes start with a hanging pole at rest


class ObservationKind(StrEnum):
    """The form in which the agent observes the measured state."""

    RAW = "raw"  # x, x_dot, theta wrapped, theta_dot: the thesis's four numbers
    COS_SIN = "cos_sin"  # x, x_dot, cos theta, sin theta, theta_dot, each scaled to about one
    POSITIONS = "positions"  # x, cos theta, sin theta: as cos_sin, without velocities


# The factor of each number of an observation when left and right are swapped.
MIRROR_SIGNS = {
    ObservationKind.RAW: (-1, -1, -1, -1),
    ObservationKind.COS_SIN: (-1, -1, 1, -1, -1),
    ObservationKind.POSITIONS: (-1, 1, -1),
}


def observation_size(kind: ObservationKind) -> int:
    """Return how many numbers `features.observe` returns."""
    return len(MIRROR_SIGNS[kind])


class Reward(StrEnum):
    """The formulas to choose the reward from."""

    CONSTANT = "constant"
    COSINE = "cosine"
    LINEAR_ANGLE = "linear_angle"
    POSITION = "position"
    UPRIGHT_BONUS = "upright_bonus"
    SCORE = "score"
