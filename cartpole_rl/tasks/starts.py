"""Random initial states."""

import math
from functools import cache

import torch
from torch import Tensor

from cartpole_rl.tasks.settings import Start, StartSettings


def draw_start(count: int, start: StartSettings, generator: torch.Generator) -> Tensor:
    """Draw true states [count, 4]: x m, x_dot m/s, theta rad, theta_dot rad/s."""
    device = generator.device
    unit = 2 * torch.rand((count, 4), generator=generator, device=device) - 1
    state = torch.addcmul(*bounds(start, device, resting=False), unit)
    if start.resting_share == 0:
        return state
    rests = torch.rand((count, 1), generator=generator, device=device) < start.resting_share
    return torch.where(rests, torch.addcmul(*bounds(start, device, resting=True), unit), state)


@cache
def bounds(start: StartSettings, device: torch.device, resting: bool) -> tuple[Tensor, Tensor]:
    """Return centre and spread [4] of the initial states; with `resting`, of those at rest."""
    angle, angle_spread = {
        Start.UPRIGHT: (0.0, start.angle_spread),
        Start.HANGING: (math.pi, start.angle_spread),
        Start.ANY: (0.0, math.pi),
    }[start.angle]
    spread = [start.position_spread, start.speed_spread, angle_spread, start.angular_speed_spread]
    if resting:
        angle, spread = math.pi, [start.position_spread, 0.0, 0.0, 0.0]
    return torch.tensor([0.0, 0.0, angle, 0.0], device=device), torch.tensor(spread, device=device)
