"""The matcher finds initial states and shared numbers of trajectories whose equations are known."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from cartpole_rl.identification.fit import correlation, neighbours_correlate
from cartpole_rl.identification.matching import (
    ROBUST,
    RUNAWAY,
    Matching,
    finest_scale,
    first_guess,
    huber,
    prior_cost,
    prior_weights,
    scaled_residuals,
)
from cartpole_rl.rig.hardware import nominal_encoders

PERIOD = 0.02
COUNT = np.array([nominal_encoders().metres, nominal_encoders().radians])
TIME = PERIOD * torch.arange(26, dtype=torch.float64).reshape(-1, 1, 1)
ACCELERATION = 0.7  # m/s^2, shared by all windows


def accelerated(points: Tensor, motion: Tensor) -> Tensor:
    """Positions [F, 2, W, K] of carts of acceleration `points` [1, K], or none, and of poles with none."""
    x, x_dot, theta, theta_dot = motion
    acceleration = points[0] if len(points) else 0
    cart = x + x_dot * TIME + acceleration * TIME**2 / 2
    pole = theta + theta_dot * TIME
    return torch.stack((cart, pole), 1)


@pytest.fixture
def motion() -> Tensor:
    """Initial states [4, W] of windows."""
    random = torch.Generator().manual_seed(0)
    spread = torch.tensor([0.1, 0.4, math.pi, 3.0], dtype=torch.float64).unsqueeze(1)
    return spread * (2 * torch.rand(4, 12, generator=random, dtype=torch.float64) - 1)


def problem(motion: Tensor, acceleration: list[float], limit: float = math.inf) -> Matching:
    points = torch.tensor(acceleration, dtype=torch.float64).reshape(-1, 1)
    count = torch.from_numpy(COUNT).unsqueeze(1)
    measured = count * (accelerated(points, motion.unsqueeze(2)).squeeze(3) / count).round()
    ends = torch.full((len(acceleration),), limit, dtype=torch.float64)
    return Matching(accelerated, measured, finest_scale(COUNT), first_guess(measured, PERIOD), (-ends, ends))


def test_shared_numbers_and_initial_states_are_found(motion: Tensor) -> None:
    matching = problem(motion, [ACCELERATION])
    match = matching.minimize(torch.zeros(1, dtype=torch.float64), matching.guess, 20)
    assert match.point.item() == pytest.approx(ACCELERATION, rel=1e-3)
    error = (match.motion - motion).abs().amax(1)
    assert (error < torch.tensor([2e-5, 2e-4, 1e-3, 1e-2], dtype=torch.float64)).all()  # m, m/s, rad, rad/s


def test_a_point_stays_within_its_limits(motion: Tensor) -> None:
    matching = problem(motion, [ACCELERATION], limit=0.5)
    match = matching.minimize(torch.zeros(1, dtype=torch.float64), matching.guess, 20)
    assert match.point.item() == 0.5


def test_the_covariance_covers_the_truth(motion: Tensor) -> None:
    matching = problem(motion, [ACCELERATION])
    match = matching.minimize(torch.zeros(1, dtype=torch.float64), matching.guess, 20)
    normal = matching.normal_equations(match.point, match.motion)
    one_episode = normal.covariance(torch.zeros(12, dtype=torch.int64))
    assert abs(match.point.item() - ACCELERATION) < 4 * one_episode.sqrt().item() < 0.01


def test_the_loss_is_quadratic_and_then_linear() -> None:
    sizes = torch.tensor([0.5, ROBUST, 2 * ROBUST, 3 * ROBUST], dtype=torch.float64)
    losses = huber(sizes)
    assert torch.equal(losses, huber(-sizes))
    assert losses[:2].tolist() == [0.25, ROBUST**2]
    assert losses[3] - losses[2] == losses[2] - losses[1]


def test_the_prior_is_gaussian_near_its_mean_and_lets_go_of_a_cart_unlike_its_file() -> None:
    point = torch.tensor([0.1, -3.0, 10.0], dtype=torch.float64, requires_grad=True)
    cost = prior_cost(point)
    (slope,) = torch.autograd.grad(cost, point)
    torch.testing.assert_close(slope, 2 * prior_weights(point) * point)
    assert prior_weights(point).tolist() == pytest.approx([1, 0.5, 0.08], abs=0.003)


def test_a_diverged_prediction_has_a_finite_residual() -> None:
    positions = torch.tensor([[[math.nan], [math.inf]], [[-1e300], [0.0]]], dtype=torch.float64)
    residuals = scaled_residuals(positions, torch.zeros_like(positions), finest_scale(COUNT))
    assert residuals.flatten().tolist() == [RUNAWAY, RUNAWAY, -RUNAWAY, 0.0]


@pytest.mark.filterwarnings("error")
def test_constant_residuals_do_not_correlate() -> None:
    assert neighbours_correlate(torch.ones(5, 26).numpy()) == 0
    assert correlation(torch.arange(9.0).numpy(), torch.zeros(9).numpy()) == 0
    assert correlation(torch.arange(9.0).numpy(), -torch.arange(9.0).numpy()) == pytest.approx(-1)
