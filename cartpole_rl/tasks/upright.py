"""The definition of upright: the angle of score (6.2), and how long it has to be held."""

import math

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.tasks.rewards import UPRIGHT_ANGLE

HOLD = 1.0  # s that the pole has to stay upright


def wrap(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles in rad, of any shape, wrapped to (-pi, pi]."""
    return -((-theta + math.pi) % (2 * math.pi) - math.pi)


def is_upright(theta: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return True for each angle (rad, wrapped or not) within 5 degrees of upright."""
    return np.abs(wrap(theta)) < UPRIGHT_ANGLE


def upright_at_end(time: NDArray[np.float64], theta: NDArray[np.float64]) -> bool:
    """Return True if the pole is upright during the whole last second (`HOLD`).

    `time` [T] in s, ascending; `theta` [T] in rad.
    """
    last = time >= time[-1] - HOLD
    return bool(time[-1] - time[0] >= HOLD and is_upright(theta[last]).all())


def upright_since(time: NDArray[np.float64], theta: NDArray[np.float64]) -> float | None:
    """Return the first time (s) from which the pole stays upright for one second; None if it never does.

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
