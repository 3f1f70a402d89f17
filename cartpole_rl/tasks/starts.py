"""Where an episode starts: draws of the true state."""

import math
from enum import StrEnum

import torch
from torch import Tensor

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


def draw_start(count: int, start: StartSettings, generator: torch.Generator) -> Tensor:
    """True states [count, 4]: x m, x_dot m/s, theta rad, theta_dot rad/s."""
    unit = 2 * torch.rand((count, 4), generator=generator, device=generator.device) - 1
    about = math.pi if start.angle is Start.HANGING else 0.0
    angle_spread = math.pi if start.angle is Start.ANY else start.angle_spread
    spread = unit.new_tensor(
        [start.position_spread, start.speed_spread, angle_spread, start.angular_speed_spread]
    )
    state = unit * spread + unit.new_tensor([0.0, 0.0, about, 0.0])
    if start.resting_share == 0:
        return state
    rests = torch.rand((count, 1), generator=generator, device=generator.device) < start.resting_share
    at_rest = unit * unit.new_tensor([start.position_spread, 0.0, 0.0, 0.0]) + unit.new_tensor(
        [0, 0, math.pi, 0]
    )
    return torch.where(rests, at_rest, state)
