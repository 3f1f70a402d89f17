"""What can be chosen of a task: where episodes start, what the agent observes, what it is rewarded for."""

from enum import StrEnum

from cartpole_rl.settings import Fraction, NonNegative, Settings


class Start(StrEnum):
    """Which angle of the pole an episode starts from."""

    UPRIGHT = "upright"
    HANGING = "hanging"
    ANY = "any"  # uniform in (-180, 180] degrees


class StartSettings(Settings):
    """How an episode starts: everything is drawn uniformly within plus or minus its spread."""

    angle: Start
    position_spread: NonNegative  # m, of the cart about the middle
    angle_spread: NonNegative  # rad, about upright or hanging
    speed_spread: NonNegative  # m/s
    angular_speed_spread: NonNegative  # rad/s
    resting_share: Fraction = 0.0  # of the episodes: the pole hangs and everything is at rest


class ObservationKind(StrEnum):
    """How the measured state is shown to the agent."""

    RAW = "raw"  # x, x_dot, theta wrapped, theta_dot: the thesis's four numbers
    COS_SIN = "cos_sin"  # x, x_dot, cos theta, sin theta, theta_dot, each scaled to about one
    POSITIONS = "positions"  # x, cos theta, sin theta: as cos_sin, velocities hidden


# What each number of an observation is multiplied by when left and right are swapped.
MIRROR_SIGNS = {
    ObservationKind.RAW: (-1, -1, -1, -1),
    ObservationKind.COS_SIN: (-1, -1, 1, -1, -1),
    ObservationKind.POSITIONS: (-1, 1, -1),
}


def observation_size(kind: ObservationKind) -> int:
    """Numbers that `observe` gives."""
    return len(MIRROR_SIGNS[kind])


class Reward(StrEnum):
    """What the agent learns from."""

    CONSTANT = "constant"
    COSINE = "cosine"
    LINEAR_ANGLE = "linear_angle"
    POSITION = "position"
    UPRIGHT_BONUS = "upright_bonus"
    SCORE = "score"
