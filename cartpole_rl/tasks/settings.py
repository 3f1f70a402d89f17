"""The initial states of a task."""

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
