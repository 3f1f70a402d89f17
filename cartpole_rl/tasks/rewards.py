"""Rewards (5.1) to (5.5) and the scores (6.1) and (6.2): functions of the measured state, [N] -> [N].

Every agent is judged by both scores, whatever reward it learned from.
"""

import math
from collections.abc import Callable
from enum import StrEnum

import torch
from torch import Tensor

UPRIGHT_ANGLE = math.radians(5)  # rad
UPRIGHT_SPEED = math.radians(6)  # rad/s
BONUS = 5.0  # (6.2), given once for the angle and once more for angle and speed
UPRIGHT_BONUS = 10.0  # (5.5)
BALANCE_ANGLE = math.radians(12)  # rad, theta_thr of (5.5): where the classical task ends


class Reward(StrEnum):
    """What the agent learns from."""

    CONSTANT = "constant"
    COSINE = "cosine"
    LINEAR_ANGLE = "linear_angle"
    POSITION = "position"
    UPRIGHT_BONUS = "upright_bonus"
    SCORE = "score"


def constant(state: Tensor, x_max: float) -> Tensor:
    """(5.1): 1."""
    return torch.ones_like(state[:, 0])


def cosine(state: Tensor, x_max: float) -> Tensor:
    """(5.2): cos(theta / 2)."""
    return torch.cos(0.5 * state[:, 2])


def linear_angle(state: Tensor, x_max: float) -> Tensor:
    """(5.3): (pi - |theta|) / pi."""
    return 1 - state[:, 2].abs() / math.pi


def position(state: Tensor, x_max: float) -> Tensor:
    """(5.4) and (6.1): cos(theta / 2) (x_max - |x|) / x_max, not below 0, at most 1 a step."""
    return cosine(state, x_max) * (1 - state[:, 0].abs() / x_max).clamp(min=0)


def upright_bonus(state: Tensor, x_max: float) -> Tensor:
    """(5.5): (5.4) and 10 while |theta| < 12 degrees."""
    return position(state, x_max) + UPRIGHT_BONUS * (state[:, 2].abs() < BALANCE_ANGLE)


def score(state: Tensor, x_max: float) -> Tensor:
    """(6.2): (6.1), 5 while |theta| < 5 degrees, 5 more if also |theta_dot| < 6 degrees/s; at most 11."""
    upright = state[:, 2].abs() < UPRIGHT_ANGLE
    still = upright & (state[:, 3].abs() < UPRIGHT_SPEED)
    return position(state, x_max) + BONUS * (upright.to(state.dtype) + still.to(state.dtype))


REWARDS: dict[Reward, Callable[[Tensor, float], Tensor]] = {
    Reward.CONSTANT: constant,
    Reward.COSINE: cosine,
    Reward.LINEAR_ANGLE: linear_angle,
    Reward.POSITION: position,
    Reward.UPRIGHT_BONUS: upright_bonus,
    Reward.SCORE: score,
}
SCORE_UPRIGHT = Reward.POSITION  # (6.1) is (5.4)
SCORE = Reward.SCORE  # (6.2)
