"""Reasons of ending. The plant reports track, fault and link; angle and time belong to the task."""

from enum import StrEnum

import torch
from torch import Tensor

from cartpole_rl.tasks.features import Measured


class Ending(StrEnum):
    """The reasons of ending in metrics.json and recordings."""

    TIME = "time"  # truncated: the time limit
    ANGLE = "angle"  # terminated: the balance task's pole fell
    TRACK = "track"  # terminated: the cart left the track
    FAULT = "fault"  # truncated: the cart latched a fault, or a count froze or jumped
    LINK = "link"  # truncated: the cart stopped answering
    NON_FINITE = "non_finite"  # truncated: an observation or an action value was not finite


def fallen(state: Measured, angle_limit: float | None) -> Tensor:
    """Return [N] bool: the measured |theta| exceeds `angle_limit` rad. None means no limit."""
    if angle_limit is None:
        return torch.zeros_like(state.theta, dtype=torch.bool)
    return state.theta.abs() > angle_limit
