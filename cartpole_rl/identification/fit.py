"""Finds the cart whose predictions match recorded windows: Gauss-Newton on trajectories.

Residuals are encoder counts of positions only. Each window's beginning is free and is eliminated from the
normal equations (variable projection; Golub and Pereyra, 1973), so that no velocity is ever measured.
Derivatives are differences of carts that are simulated side by side. One-step regression, the thesis's way,
puts the same quantized sample into regressor and target, and one count at 50 Hz is 0.077 rad/s.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.identification.prediction import predict
from cartpole_rl.identification.unknowns import POLE_LENGTH, Unknown, limits, parameters_at, unknowns_of
from cartpole_rl.identification.windows import Windows
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT

Array = NDArray[np.floating]
SCALE = np.array([20.0, 3.0])  # counts: errors of cart and pole that count as one, 0.5 mm and 0.26 degrees
FINEST = np.array([1.0, 0.5])  # counts: what quantization alone leaves, about
ROBUST = 3.0  # scaled residuals beyond this count linearly (Huber)
LOST = 1e6  # scaled residual of a prediction that ran away
STEP = 1e-5  # of an unknown, for its derivative; larger ones find what no data can tell: all forces' scale
STATE_STEP = np.array([1e-7, 1e-6, 1e-6, 1e-5])  # m, m/s, rad, rad/s
STATE_SPREAD = np.array([5e-4, 0.1, 5e-3, 1.0])  # of a window's beginning about its first guess
STARTS: tuple[Mapping[str, float], ...] = (  # points to search from; what a start does not name is 0
    {},
    {POLE_LENGTH: 1.25},  # a pole of another length looks like a pole of no kind
    {POLE_LENGTH: -1.0},
    {"latency": 1.5, "motor_time_constant": -0.7},  # a delay looks much like a lag
    {"latency": -0.7, "motor_time_constant": 1.5},
)
CONVERGED = 1e-4  # relative fall of the cost
CORRELATED = 10.0  # residuals of one window resemble each other: so many say as much as one


@dataclass(frozen=True)
class Fit:
    """A cart found, and how surely."""

    unknowns: list[Unknown]
    point: Array  # [U], in standard deviations before measurement
    covariance: Array  # [U, U] of `point`
    nominal: dict[str, float]
    rms: Array  # [2] counts: of the residuals of cart and pole, robustly
    correlation: Array  # [2] of each residual with the next one in its window
    cost: float
    iterations: int

    @property
    def parameters(self) -> dict[str, float]:
        """Every parameter of the cart that was found."""
        table = parameters_at(self.point[:, None], self.unknowns, self.nominal)[:, 0]
        return dict(zip(CartParameters.names(), table.tolist(), strict=True))

    def draw(self, count: int, random: np.random.Generator, widen: float = 1.0) -> Array:
        """Carts [P, count] drawn from what is now thought of it, correlations included."""
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(len(self.point)))
        points = self.point[:, None] + widen * root @ random.standard_normal((len(self.point), count))
        return parameters_at(points, self.unknowns, self.nominal).numpy()


def fit_cart(
    windows: Windows,
    nominal: Mapping[str, float],
    models: Models,
    period: float,
    substeps: int = 4,
    iterations: int = 25,
    known: Sequence[str] = (),
    sharpened: bool = False,
    lead: float = 0.0,
) -> Fit:
    """The most probable cart, from several starts.

    The names `known`, of UNKNOWNS, keep their nominal values. Nothing but ratios of forces and masses shows
    in motion: without WEIGHED among them the scale is that of the prior.
    `lead` is that of `predict`.
    `sharpened`: once found, it is looked for again with errors counted by the size that they have.
    """
    unknowns = unknowns_of(models, known)
    problem = Problem(windows, dict(nominal), models, period, substeps, unknowns, SCALE, lead)
    names = [unknown.name for unknown in unknowns]
    starts = [
        problem.minimize(np.array([start.get(name, 0.0) for name in names]), problem.beginnings(), 4)
        for start in STARTS
        if start.keys() <= {*names}
    ]
    best = min(starts, key=lambda each: each.cost)
    best = problem.minimize(best.point, best.motion, iterations)
    if sharpened:
        scale = np.maximum(problem.report(best).rms, FINEST)
        problem = Problem(windows, dict(nominal), models, period, substeps, unknowns, scale, lead)
        best = problem.minimize(best.point, best.motion, iterations)
    return problem.report(best)


@dataclass(frozen=True)
class Iterate:
    """Where the search stands."""

    point: Array  # [U]
    motion: Array  # [4, W], the windows' beginnings
    cost: float
    iterations: int


class Problem:
    """The least-squares problem of one set of windows."""

    def __init__(
        self,
        windows: Windows,
        nominal: dict[str, float],
        models: Models,
        period: float,
        substeps: int,
        unknowns: Sequence[Unknown],
        scale: Array,
        lead: float,
    ) -> None:
        self.scale, self.lead = scale, lead
        self.windows, self.nominal, self.models = windows, nominal, models
        self.period, self.substeps, self.unknowns = period, substeps, list(unknowns)
        self.first, self.limits = self.beginnings(), limits(unknowns, nominal)

    def beginnings(self) -> Array:
        """First guess of each window's state, [4, W]: a parabola through its first five positions."""
        time = np.arange(5) * self.period
        metres = self.windows.positions[:5, 0] * CART_METRES_PER_COUNT
        radians = self.windows.positions[:5, 1] * POLE_RADIANS_PER_COUNT
        (_, x_dot, x), (_, theta_dot, theta) = np.polyfit(time, metres, 2), np.polyfit(time, radians, 2)
        return np.stack((x, x_dot, theta, theta_dot))

    def residuals(self, points: Array, motion: Array) -> Array:
        """Scaled residuals [K, W, M] at `points` [U, K] with beginnings `motion` [4, K, W]."""
        variants, count = points.shape[1], self.windows.number
        table = parameters_at(points, self.unknowns, self.nominal)
        predicted = predict(
            table.repeat_interleave(count, 1),
            torch.from_numpy(motion.reshape(4, -1)),
            torch.from_numpy(np.tile(self.windows.motors, (1, variants))),
            self.models,
            self.period,
            self.substeps,
            self.lead,
        ).numpy()
        error = predicted.reshape(-1, 2, variants, count) - self.windows.positions[:, :, None]
        scaled = (error / self.scale[:, None, None]).transpose(2, 3, 0, 1).reshape(variants, count, -1)
        return np.nan_to_num(scaled, nan=LOST, posinf=LOST, neginf=-LOST).clip(-LOST, LOST)

    def cost(self, residuals: Array, point: Array, motion: Array) -> float:
        """Huber's cost of residuals [W, M], and what was thought before."""
        size = np.abs(residuals)
        loss = np.where(size < ROBUST, size**2, 2 * ROBUST * size - ROBUST**2).sum()
        strayed = (motion - self.first) / STATE_SPREAD[:, None]
        return float(loss / CORRELATED + point @ point + (strayed**2).sum() / CORRELATED)

    def linearize(self, point: Array, motion: Array) -> tuple[Array, Array, Array]:
        """Residuals [W, M], their derivatives by the point [W, M, U] and by the beginning [W, M, 4]."""
        size = len(point)
        points = np.repeat(point[:, None], 1 + size + 4, 1)
        points[np.arange(size), 1 + np.arange(size)] += STEP
        motions = np.repeat(motion[:, None], 1 + size + 4, 1)
        motions[np.arange(4), 1 + size + np.arange(4)] += STATE_STEP[:, None]
        all_of_them = self.residuals(points, motions)
        base = all_of_them[0]
        by_point = (all_of_them[1 : 1 + size] - base) / STEP
        by_state = (all_of_them[1 + size :] - base) / STATE_STEP[:, None, None]
        return base, by_point.transpose(1, 2, 0), by_state.transpose(1, 2, 0)

    def minimize(self, point: Array, motion: Array, iterations: int) -> Iterate:
        """Levenberg-Marquardt from a point and beginnings."""
        damping, made = 1e-2, 0
        cost = self.cost(self.residuals(point[:, None], motion[:, None])[0], point, motion)
        while made < iterations:
            made += 1
            normal = self.normal_equations(point, motion)
            before = cost
            for _ in range(6):
                step, moves = normal.solve(damping)
                trial, trial_motion = np.clip(point + step, *self.limits), motion + moves
                trial_cost = self.cost(
                    self.residuals(trial[:, None], trial_motion[:, None])[0], trial, trial_motion
                )
                if trial_cost < cost:
                    point, motion, cost = trial, trial_motion, trial_cost
                    damping = max(damping / 5, 1e-6)
                    break
                damping *= 8
            if before - cost < CONVERGED * before:
                break
        return Iterate(point, motion, cost, made)

    def normal_equations(self, point: Array, motion: Array) -> "NormalEquations":
        """The quadratic that touches the cost here."""
        residuals, by_point, by_state = self.linearize(point, motion)
        weights = np.minimum(1.0, ROBUST / np.maximum(np.abs(residuals), 1e-9)) / CORRELATED
        strayed = (motion - self.first).T / STATE_SPREAD**2 / CORRELATED  # [W, 4]
        weighted_point, weighted_state = by_point * weights[..., None], by_state * weights[..., None]
        return NormalEquations(
            point_points=np.einsum("wmi,wmj->wij", weighted_point, by_point),
            point_state=np.einsum("wmi,wmj->wij", weighted_point, by_state),
            state_state=np.einsum("wmi,wmj->wij", weighted_state, by_state)
            + np.diag(1 / STATE_SPREAD**2) / CORRELATED,
            point_slopes=np.einsum("wmi,wm->wi", weighted_point, residuals),
            prior_slope=point,
            state_slope=np.einsum("wmi,wm->wi", weighted_state, residuals) + strayed,
        )

    def report(self, found: Iterate) -> Fit:
        """The fit, with its covariance and the size of its residuals."""
        residuals = self.residuals(found.point[:, None], found.motion[:, None])[0]
        normal = self.normal_equations(found.point, found.motion)
        by_channel = residuals.reshape(self.windows.number, -1, 2)
        spread = 1.4826 * np.median(np.abs(by_channel), axis=(0, 1))
        return Fit(
            self.unknowns,
            found.point,
            normal.covariance(self.windows.episode),
            self.nominal,
            spread * self.scale,
            np.array([neighbours_correlate(by_channel[..., channel]) for channel in range(2)]),
            found.cost,
            found.iterations,
        )


def neighbours_correlate(residuals: Array) -> float:
    """Correlation of each residual with the next one of its window; `residuals` [W, T + 1]."""
    small = np.clip(residuals, -ROBUST, ROBUST)
    return float(np.corrcoef(small[:, :-1].ravel(), small[:, 1:].ravel())[0, 1])


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of the normal equations; the windows' beginnings see each other only through the point."""

    point_points: Array  # [W, U, U], of each window
    point_state: Array  # [W, U, 4]
    state_state: Array  # [W, 4, 4]
    point_slopes: Array  # [W, U], of each window
    prior_slope: Array  # [U]
    state_slope: Array  # [W, 4]

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """The equations of the point alone: [U, U], each window's share [W, U]; inverse blocks [W, 4, 4]."""
        diagonal = np.einsum("wii->wi", self.state_state)
        damped = self.state_state + damping * diagonal[:, :, None] * np.eye(4)
        inverse = np.linalg.inv(damped)
        carried = self.point_state @ inverse
        matrix = self.point_points.sum(0) + np.eye(len(self.prior_slope))
        matrix += damping * np.diag(np.diag(matrix))
        matrix -= np.einsum("wis,wjs->ij", carried, self.point_state)
        slopes = self.point_slopes - np.einsum("wis,ws->wi", carried, self.state_slope)
        return matrix, slopes, inverse

    def each_reduced(self) -> Array:
        """Each window's share of the equations of the point alone, [W, U, U]."""
        carried = self.point_state @ np.linalg.inv(self.state_state)
        return self.point_points - np.einsum("wis,wjs->wij", carried, self.point_state)

    def solve(self, damping: float) -> tuple[Array, Array]:
        """The step of the point [U] and of the beginnings [4, W]."""
        matrix, slopes, inverse = self.reduced(damping)
        step = -np.linalg.solve(matrix, slopes.sum(0) + self.prior_slope)
        rest = self.state_slope + np.einsum("wis,i->ws", self.point_state, step)
        return step, -np.einsum("wst,wt->sw", inverse, rest)

    def covariance(self, episode: NDArray[np.int64]) -> Array:
        """Of the point, [U, U]: prior, and by how much windows and episodes (`episode` [W]) disagree.

        Errors within a window resemble each other, so that a window counts as one observation (White, 1980).
        What the laws of the cart lack shows as episodes that would each have another cart: the point moves
        when one is left out, which is the jackknife's variance (Tukey, 1958), to first order.
        """
        matrix, slopes, _ = self.reduced(0.0)
        inverse, count = np.linalg.inv(matrix), len(slopes)
        centred = slopes - slopes.mean(0)
        spread = centred.T @ centred * count / max(1, count - 1)
        sampled = inverse @ (spread + np.eye(len(matrix))) @ inverse
        groups = np.unique(episode)
        if len(groups) < 2:
            return sampled
        per_window = self.each_reduced()
        moves = np.stack(
            [
                np.linalg.solve(matrix - per_window[episode == group].sum(0), slopes[episode == group].sum(0))
                for group in groups
            ]
        )
        moves -= moves.mean(0)
        return sampled + (len(groups) - 1) / len(groups) * moves.T @ moves
