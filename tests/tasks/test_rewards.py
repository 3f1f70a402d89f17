"""Rewards (5.1) to (5.5) and scores (6.1), (6.2), by hand."""

import math

import pytest
import torch

from cartpole_rl.tasks.features import Measured
from cartpole_rl.tasks.rewards import SCORE, SCORE_UPRIGHT, Reward

X_MAX = 0.4
DEGREE = math.pi / 180


def value(
    kind: Reward, x: float = 0.0, theta: float = 0.0, theta_dot: float = 0.0, x_dot: float = 0.0
) -> float:
    state = torch.tensor([[x, x_dot, theta, theta_dot]], dtype=torch.float64)
    return kind.formula(Measured(*state.unbind(1)), X_MAX).item()


def random_states(count: int, side: int = 1) -> Measured:
    unit = 2 * torch.rand((count, 4), generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1
    return Measured(*(side * unit * torch.tensor([X_MAX, 2.0, math.pi, 10.0])).unbind(1))


@pytest.mark.parametrize(
    ("kind", "state", "expected"),
    [
        (Reward.CONSTANT, {"x": 0.3, "theta": 2.0}, 1.0),
        (Reward.COSINE, {"theta": math.pi / 3}, math.sqrt(3) / 2),
        (Reward.COSINE, {"theta": math.pi}, 0.0),
        (Reward.LINEAR_ANGLE, {"theta": math.pi / 4}, 0.75),
        (Reward.LINEAR_ANGLE, {"theta": -math.pi}, 0.0),
        (Reward.POSITION, {"theta": math.pi / 3, "x": 0.1}, math.sqrt(3) / 2 * 0.75),
        (Reward.POSITION, {"x": X_MAX}, 0.0),
        (Reward.LINEAR_ANGLE_POSITION, {"theta": -math.pi / 4, "x": 0.1}, 0.75 * 0.75),
        (Reward.LINEAR_ANGLE_POSITION, {"x": 1.5 * X_MAX}, 0.0),
        (Reward.POSITION, {"x": 1.5 * X_MAX}, 0.0),
        (Reward.UPRIGHT_BONUS, {"theta": 11.9 * DEGREE, "x": 0.1}, math.cos(5.95 * DEGREE) * 0.75 + 10),
        (Reward.UPRIGHT_BONUS, {"theta": 12.1 * DEGREE, "x": 0.1}, math.cos(6.05 * DEGREE) * 0.75),
        (Reward.SCORE, {"theta": 4.9 * DEGREE, "theta_dot": 5.9 * DEGREE}, math.cos(2.45 * DEGREE) + 10),
        (Reward.SCORE, {"theta": 4.9 * DEGREE, "theta_dot": 6.1 * DEGREE}, math.cos(2.45 * DEGREE) + 5),
        (Reward.SCORE, {"theta": 5.1 * DEGREE, "theta_dot": 0.0}, math.cos(2.55 * DEGREE)),
        (Reward.SCORE, {"theta": math.pi}, 0.0),
    ],
)
def test_value(kind: Reward, state: dict[str, float], expected: float) -> None:
    assert value(kind, **state) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("kind", Reward)
def test_rewards_are_largest_upright_in_the_middle_and_never_negative(kind: Reward) -> None:
    most = 11 if kind in (Reward.UPRIGHT_BONUS, Reward.SCORE) else 1
    assert value(kind) == most
    values = kind.formula(random_states(10_000), X_MAX)
    assert values.max() <= most
    assert values.min() >= 0


def test_scores_of_an_episode_are_at_most_500_and_5500() -> None:
    """The thesis says 5000 for (6.2); 500 steps of 11 are 5500."""
    assert 500 * value(SCORE_UPRIGHT) == 500
    assert 500 * value(SCORE) == 5500


@pytest.mark.parametrize("kind", Reward)
def test_rewards_are_symmetric(kind: Reward) -> None:
    right, left = (kind.formula(random_states(1000, side), X_MAX) for side in (1, -1))
    torch.testing.assert_close(right, left)
