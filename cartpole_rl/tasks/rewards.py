"""Rewards (5.1) to (5.5) and the scores (6.1) and (6.2): functions of the measured state, [N] -> [N].

To add a reward, add its formula and a member to `Reward`; and a choice in `conf/reward/`. Formulas use
methods of tensors alone, so that settings import this module without PyTorch.

Both scores are reported for every agent, whatever its reward.
"""

import math
from collections.abc import Callable
from enum import StrEnum
from typing import TYPE_CHECKING, Self

from cartpole_rl.rig.hardware import Encoders
from cartpole_rl.tasks.features import Measured

if TYPE_CHECKING:
    from torch import Tensor

Formula = Callable[[Measured, float], "Tensor"]  # of the measured state and x_max, m, to [N]

UPRIGHT_ANGLE = math.radians(5)  # rad
UPRIGHT_SPEED = math.radians(6)  # rad/s
SPEED_TIME = 0.02  # s over which rewards and scores measure it at least: the control period of the thesis
BONUS = 5.0  # (6.2), once for the angle and once more for angle and speed
UPRIGHT_BONUS = 10.0  # (5.5)
BALANCE_ANGLE = math.radians(12)  # rad, theta_thr of (5.5): where the classical task ends


def speed_periods(control_period: float, encoders: Encoders) -> int:
    """Return over how many control periods, s each, rewards and scores measure the pole's speed.

    (6.2) is defined for 20 ms. Over a shorter time, or with a coarse encoder, a single count would be faster
    than UPRIGHT_SPEED, and a pole that stands would not be still whenever its count changes. A tenth more
    than the time of one count is room for periods that differ. Before an episode the pole counts as at rest.
    """
    seconds = max(SPEED_TIME, 1.1 * encoders.radians / UPRIGHT_SPEED)
    return max(1, math.ceil(seconds / control_period - 1e-9))


def constant(state: Measured, x_max: float) -> "Tensor":
    """(5.1): 1."""
    return state.x.new_ones(state.x.shape)


def cosine(state: Measured, x_max: float) -> "Tensor":
    """(5.2): cos(theta / 2)."""
    return (0.5 * state.theta).cos()


def linear_angle(state: Measured, x_max: float) -> "Tensor":
    """(5.3): (pi - |theta|) / pi."""
    return 1 - state.theta.abs() / math.pi


def position(state: Measured, x_max: float) -> "Tensor":
    """(5.4) and (6.1): cos(theta / 2) (x_max - |x|) / x_max, from 0 to 1 per step."""
    return cosine(state, x_max) * centred(state, x_max)


def linear_angle_position(state: Measured, x_max: float) -> "Tensor":
    """(5.4) with (5.3) in place of its cosine (thesis 6.2, figure 6.7b), from 0 to 1 per step."""
    return linear_angle(state, x_max) * centred(state, x_max)


def centred(state: Measured, x_max: float) -> "Tensor":
    """Return the factor of the position in (5.4), (x_max - |x|) / x_max; 0 beyond x_max."""
    return (1 - state.x.abs() / x_max).clamp(min=0)


def upright_bonus(state: Measured, x_max: float) -> "Tensor":
    """(5.5): (5.4) and 10 while |theta| < 12 degrees."""
    return position(state, x_max) + UPRIGHT_BONUS * (state.theta.abs() < BALANCE_ANGLE)


def score(state: Measured, x_max: float) -> "Tensor":
    """(6.2): (6.1), 5 while |theta| < 5 degrees, 5 more if also |theta_dot| < 6 degrees/s; at most 11."""
    upright = state.theta.abs() < UPRIGHT_ANGLE
    still = upright & (state.theta_dot.abs() < UPRIGHT_SPEED)
    return position(state, x_max) + BONUS * (upright.to(state.theta.dtype) + still.to(state.theta.dtype))


class Reward(StrEnum):
    """The rewards to choose from: name and formula. The value of a member is its name."""

    formula: Formula

    CONSTANT = "constant", constant
    COSINE = "cosine", cosine
    LINEAR_ANGLE = "linear_angle", linear_angle
    POSITION = "position", position
    LINEAR_ANGLE_POSITION = "linear_angle_position", linear_angle_position
    UPRIGHT_BONUS = "upright_bonus", upright_bonus
    SCORE = "score", score

    def __new__(cls, name: str, formula: Formula) -> Self:
        """Make a member."""
        member = str.__new__(cls, name)
        member._value_, member.formula = name, formula
        return member


SCORE_UPRIGHT = Reward.POSITION  # (6.1) is (5.4)
SCORE = Reward.SCORE  # (6.2)
