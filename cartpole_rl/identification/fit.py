"""Fit of a cart whose predictions match recorded windows.

Residuals are those of positions only; see `matching`. One-step regression, the thesis's way, puts
the same quantized sample into regressor and target, and one count at 50 Hz is 0.077 rad/s.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.matching import (
    COARSE,
    NO_CART,
    ROBUST,
    Match,
    Matching,
    finest_scale,
    first_guess,
    solvable,
)
from cartpole_rl.identification.rollout import rollout
from cartpole_rl.identification.unknowns import (
    POLE_LENGTH,
    Unknown,
    hidden,
    limits,
    parameters_at,
    sized,
    unknowns_of,
)
from cartpole_rl.identification.windows import Windows
from cartpole_rl.physics.models import Models, check_laws
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.rig.parameters import completed

Array = NDArray[np.floating]
STARTS: tuple[Mapping[str, float], ...] = (  # points to search from; an unknown that is not named is 0
    {},
    {POLE_LENGTH: 1.25},  # a pole of another length looks like a pole of no kind
    {POLE_LENGTH: -1.0},
    {"latency": 1.5, "motor_time_constant": -0.7},  # a delay looks much like a lag
    {"latency": -0.7, "motor_time_constant": 1.5},
)
SCREENING = 4  # iterations from each start
HOPELESS = np.array([1.0, math.pi])  # m, rad: residuals of no cart


@dataclass(frozen=True)
class Fit:
    """An identified cart, with its uncertainty."""

    unknowns: list[Unknown]
    point: Array  # [U], in standard deviations before measurement
    covariance: Array  # [U, U] of `point`
    nominal: dict[str, float]
    spread: Array  # [2] m, rad: of the residuals of cart and pole, 1.48 times their median size
    correlation: Array  # [2] of each residual with the next one in its window
    cost: float

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter of the identified cart."""
        table = parameters_at(self.point[:, None], self.unknowns, self.nominal)[:, 0]
        return dict(zip(CartParameters.names(), table.tolist(), strict=True))

    @property
    def by_name(self) -> dict[str, float]:
        """The numbers of `point` by the names of the unknowns."""
        return dict(zip((each.name for each in self.unknowns), self.point.tolist(), strict=True))

    @solvable()
    def draw(self, count: int, random: np.random.Generator, widen: float = 1.0) -> Array:
        """Return carts [P, count] drawn from the posterior, correlations included. Raises RecordingError."""
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(len(self.point)))
        points = self.point[:, None] + widen * root @ random.standard_normal((len(self.point), count))
        return parameters_at(points, self.unknowns, self.nominal).numpy()


def best_fit(
    windows: Windows,
    nominal: Mapping[str, float],
    candidates: Iterable[Models],
    period: float,
    substeps: int = 4,
) -> tuple[Fit, Models]:
    """Return the fit with the lowest cost among those under each of the `candidates`, and its models.

    Raises RecordingError for windows in which no cart moves.
    """
    fits = [(fit_cart(windows, nominal, models, period, substeps), models) for models in candidates]
    fit, chosen = min(fits, key=lambda each: each[0].cost)
    if (fit.spread > HOPELESS).any():
        raise RecordingError(NO_CART)
    return replace(fit, covariance=within_prior(fit.covariance)), chosen


def within_prior(covariance: Array) -> Array:
    """Return a covariance of points [U, U] that is nowhere wider than the prior, nor below 0 by rounding."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.clip(values, 0.0, 1.0) @ vectors.T


def fit_cart(
    windows: Windows,
    nominal: Mapping[str, float],
    models: Models,
    period: float,
    substeps: int = 4,
    iterations: int = 25,
    known: Sequence[str] = (),
    extra_latency: float = 0.0,
    near: Fit | None = None,
    sizes: Array | None = None,
    on_step: Callable[[], object] = lambda: None,
) -> Fit:
    """Return the most probable cart, searched for from several starts.

    The names `known`, of UNKNOWNS, keep their nominal values, and so do those that a stepper hides.
    Where a friction is 0 there, its prior is about that of ip02.
    Motion shows only ratios of forces and masses: unless WEIGHED are known, the prior sets the scale.
    `extra_latency` is that of `rollout`.
    The search is from the cart of `near`, if it is given; `sizes`, m and rad, [2], scale the errors.
    `on_step` is called before each linearization. Raises RecordingError for windows in which no cart moves.
    """
    check_laws(models, CartParameters(cart_column(nominal)))
    nominal = completed(nominal)
    unknowns = unknowns_of(models, (*known, *hidden(nominal)))
    nominal = sized(nominal, unknowns)
    positions, motors = torch.from_numpy(windows.positions), torch.from_numpy(windows.motors)
    guess = first_guess(positions, period)
    low, high = map(torch.from_numpy, limits(unknowns, nominal))

    def simulate(points: Tensor, motion: Tensor) -> Tensor:
        variants = points.shape[1]
        table = parameters_at(points.numpy(), unknowns, nominal).repeat(1, windows.number)
        every = motors.repeat_interleave(variants, 1)
        measured = rollout(table, motion.flatten(1), every, models, period, substeps, extra_latency)
        return measured.unflatten(2, (windows.number, variants))

    rough = COARSE if sizes is None else torch.from_numpy(sizes)
    scale = torch.maximum(rough, finest_scale(windows.resolution))
    problem = Matching(simulate, positions, scale, guess, (low, high), on_step)
    if near is None:
        starts = [start for start in STARTS if start.keys() <= {each.name for each in unknowns}]
        screened = [problem.minimize(point_of(unknowns, start), guess, SCREENING) for start in starts]
        point, motion, _ = min(screened, key=lambda each: each.cost)
    else:
        point, motion = point_of(unknowns, near.by_name), guess
    best = problem.minimize(point, motion, iterations)
    return described(problem, best, windows, unknowns, nominal)


def point_of(unknowns: Sequence[Unknown], values: Mapping[str, float]) -> Tensor:
    """Return the point [U] with these `values`; an unknown that has none is 0."""
    return torch.tensor([values.get(each.name, 0.0) for each in unknowns], dtype=torch.float64)


def described(
    problem: Matching, best: Match, windows: Windows, unknowns: list[Unknown], nominal: dict[str, float]
) -> Fit:
    """Return the cart of a match with its uncertainty and residuals."""
    residuals = problem.residuals(best.point.unsqueeze(1), best.motion.unsqueeze(2))
    residuals = residuals.squeeze(2).unflatten(1, (-1, 2))  # [W, T + 1, 2]
    # a normal distribution has 1.4826 times the median size as its standard deviation
    spread = 1.4826 * residuals.abs().flatten(0, 1).quantile(0.5, dim=0) * problem.scale
    normal = problem.normal_equations(best.point, best.motion)
    return Fit(
        unknowns,
        best.point.numpy(),
        normal.covariance(torch.from_numpy(windows.episode)).numpy(),
        nominal,
        spread.numpy(),
        np.array([neighbours_correlate(residuals[..., encoder].numpy()) for encoder in range(2)]),
        best.cost,
    )


def neighbours_correlate(residuals: Array) -> float:
    """Return the correlation of each residual with the next one of its window; `residuals` [W, T + 1]."""
    small = np.clip(residuals, -ROBUST, ROBUST)
    return correlation(small[:, :-1].ravel(), small[:, 1:].ravel())


def correlation(first: Array, second: Array) -> float:
    """Return the correlation coefficient, 0 if one of the samples is constant."""
    varies = first.size > 1 and np.ptp(first) > 0 and np.ptp(second) > 0
    return float(np.corrcoef(first, second)[0, 1]) if varies else 0.0
