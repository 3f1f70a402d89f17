"""When a pole counts as upright: the first band of score (6.2), and how long it has to be held."""

import math

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE

HOLD = 1.0  # s that the pole stays in the band before a picture says that it got there


def wrap(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in rad, of any shape, wrapped to (-pi, pi]."""
    return -((-theta + math.pi) % (2 * math.pi) - math.pi)


def is_upright(theta: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each angle (rad, wrapped or not) is within 5 degrees of upright."""
    return np.abs(wrap(theta)) < UPRIGHT_ANGLE


def upright_since(time: NDArray[np.float64], theta: NDArray[np.float64]) -> float | None:
    """First time (s) from which the pole stays upright for one second; None if it never does.

    `time` [T] in s, ascending; `theta` [T] in rad.
    """
    start: float | None = None
    for moment, upright in zip(time, is_upright(theta), strict=True):
        if not upright:
            start = None
        elif start is None:
            start = float(moment)
        elif moment - start >= HOLD:
            return start
    return None
