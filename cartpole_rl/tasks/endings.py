"""Why an episode ends. Track's end, faults and a lost link are the plant's; angle and time are the task's."""

from enum import StrEnum

import torch
from torch import Tensor

from cartpole_rl.tasks.features import Measured


class Ending(StrEnum):
    """Reasons, as they stand in metrics.json."""

    TIME = "time"  # truncated: the time limit
    ANGLE = "angle"  # terminated: the balance task's pole fell
    TRACK = "track"  # terminated: the cart left the track
    FAULT = "fault"  # terminated: the cart latched a fault
    LINK = "link"  # truncated: the cart stopped answering
    NON_FINITE = "non_finite"  # truncated: an observation or an action value was not finite


def fallen(state: Measured, angle_limit: float | None) -> Tensor:
    """Whether the measured |theta| is over `angle_limit` rad, [N] bool; None is no limit."""
    if angle_limit is None:
        return torch.zeros_like(state.theta, dtype=torch.bool)
    return state.theta.abs() > angle_limit
