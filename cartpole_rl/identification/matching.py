"""Matches simulated trajectories to recorded windows: Levenberg-Marquardt on measured positions.

The unknowns are the initial state of each window and, optionally, a point that all windows share. Initial
states are eliminated from the normal equations (variable projection; Golub and Pereyra, 1973), so that no
velocity is measured. Derivatives are differences of carts that are simulated side by side.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.physics.residual import Residual

COARSE = torch.tensor([4.55e-4, 4.6e-3], dtype=torch.float64)  # m, rad: first residual scale
QUANTIZATION = torch.tensor([1.0, 0.4], dtype=torch.float64)  # counts: the effect of quantization, about
ROBUST = 3.0  # scaled residuals beyond this count linearly (Huber)
RUNAWAY = 1e6  # scaled residual of a prediction that diverged
POINT_STEP = 1e-5  # for derivatives; larger steps suggest that the data show the scale of all forces
STATE_STEP = torch.tensor([1e-7, 1e-6, 1e-6, 1e-5], dtype=torch.float64)  # m, m/s, rad, rad/s
STATE_SPREAD = torch.tensor([5e-4, 0.5, 5e-3, 3.0], dtype=torch.float64)  # of an initial state's first guess
FARTHEST = 3.0  # of STATE_SPREAD: the largest distance of an initial state from its first guess
GUESSED_FROM = 3  # positions; when the motor reverses, later ones bend away from any parabola
PRIOR_FREEDOM = 9.0  # half the weight at three standard deviations
CORRELATED = 10.0  # this many correlated residuals of a window count as one independent residual
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-6, 1e3
EASED = 5.0  # dampings shrink by it after a step that helps; else the search creeps along narrow valleys
KEPT = 8.0  # a window's damping grows by it where its step would not lower its cost
SETTLED_DAMPING = 0.01  # beyond it, a step is short because it is damped
FACTORS = (0.1, 1.0, 10.0)  # of the dampings that are tried side by side
ATTEMPTS = 3  # to lower the cost from one linearization, with a hundred times the damping each
CONVERGED = 1e-4  # relative fall of the cost
SETTLED = 0.3  # standard deviations: the last step of a point; outliers' initial states may still move
NO_CART = (
    "no cart moves as the recordings say, their counts jump: check the encoders and their cables, and record "
    "again, or leave these recordings out"
)
ROUNDS = 10  # steps from a first guess of the initial states


@contextmanager
def solvable() -> Iterator[None]:
    """Raise RecordingError where equations have no solution: no cart causes errors of this size."""
    try:
        yield
    except (np.linalg.LinAlgError, torch.linalg.LinAlgError):
        raise RecordingError(NO_CART) from None


def huber(residuals: Tensor) -> Tensor:
    """Return squares up to ROBUST, and straight lines beyond."""
    size = residuals.abs()
    return torch.where(size < ROBUST, size**2, 2 * ROBUST * size - ROBUST**2)


def finest_scale(resolution: np.ndarray) -> Tensor:
    """Return the least scale of residuals, [2], m and rad, of encoders with that `resolution` [2]."""
    return QUANTIZATION * torch.from_numpy(resolution)


def scaled_residuals(positions: Tensor, measured: Tensor, scale: Tensor) -> Tensor:
    """Return (positions - measured) / scale [2] within RUNAWAY; all others are [F, 2, ...]."""
    error = (positions - measured) / scale.reshape(2, *[1] * (positions.dim() - 2))
    return error.nan_to_num(RUNAWAY, RUNAWAY, -RUNAWAY).clamp(-RUNAWAY, RUNAWAY)


def prior_cost(point: Tensor) -> Tensor:
    """Return the cost of a point [U]: that of a Gaussian near 0, with the tails of Student's distribution.

    A cart that is nothing like its file is not pulled to it: the motion counts.
    """
    return PRIOR_FREEDOM * (point**2 / PRIOR_FREEDOM).log1p().sum()


def prior_weights(point: Tensor) -> Tensor:
    """Return the weights of squared numbers of a point that touch `prior_cost`, [U]."""
    return 1 / (1 + point**2 / PRIOR_FREEDOM)


def first_guess(positions: Tensor, period: float) -> Tensor:
    """Return states [4, W]: parabolas through the first positions [T + 1, 2, W]."""
    known = positions[:GUESSED_FROM].numpy()
    time = np.arange(len(known)) * period
    (_, x_dot, x), (_, theta_dot, theta) = (np.polyfit(time, known[:, k], 2) for k in range(2))
    return torch.from_numpy(np.stack((x, x_dot, theta, theta_dot)))


class NormalEquations(NamedTuple):
    """Blocks of the normal equations; windows are coupled only through the point, of U numbers."""

    point_points: Tensor  # [W, U, U], of each window
    point_state: Tensor  # [W, U, 4]
    state_state: Tensor  # [W, 4, 4], prior included
    point_slopes: Tensor  # [W, U], of each window
    prior_weights: Tensor  # [U]
    prior_slope: Tensor  # [U]
    state_slope: Tensor  # [W, 4], prior included

    def reduced(self, damping: float = 0.0, own: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the equations of the point alone: [U, U], each window's share [W, U]; inverses [W, 4, 4].

        `damping` is that of the point, `own` [W] that of each window's initial state.
        """
        diagonal = self.state_state.diagonal(dim1=-2, dim2=-1)
        extra = 0 * diagonal if own is None else own.unsqueeze(-1) * diagonal
        inverse = torch.linalg.inv(self.state_state + torch.diag_embed(extra))
        carried = self.point_state @ inverse
        matrix = self.point_points.sum(0) + torch.diag(self.prior_weights)
        matrix = matrix + damping * torch.diag(matrix.diagonal())
        matrix = matrix - (carried @ self.point_state.mT).sum(0)
        slopes = self.point_slopes - torch.einsum("wis,ws->wi", carried, self.state_slope)
        return matrix, slopes, inverse

    @solvable()
    def solve(self, damping: float, own: Tensor) -> tuple[Tensor, Tensor]:
        """Return the steps of the point [U] and of the initial states [4, W].

        The arguments are those of `reduced`. Raises RecordingError, as `covariance` does.
        """
        matrix, slopes, inverse = self.reduced(damping, own)
        step = -torch.linalg.solve(matrix, slopes.sum(0) + self.prior_slope)
        rest = self.state_slope + torch.einsum("wis,i->ws", self.point_state, step)
        return step, -torch.einsum("wst,wt->sw", inverse, rest)

    @solvable()
    def length(self, step: Tensor) -> float:
        """Return the length of a step of the point [U] in standard deviations, as windows disagree.

        It is infinite where rounding leaves no length.
        """
        matrix, slopes, _ = self.reduced()
        pulled = matrix @ step
        square = float(pulled @ torch.linalg.solve(self.disagreement(slopes), pulled))
        return math.sqrt(square) if square >= 0 else math.inf

    def disagreement(self, slopes: Tensor) -> Tensor:
        """Return the covariance of the sum of the windows' slopes [W, U] and of the prior's, [U, U]."""
        centred, count = slopes - slopes.mean(0), len(slopes)
        return centred.mT @ centred * count / max(1, count - 1) + torch.diag(self.prior_weights)

    @solvable()
    def covariance(self, episode: Tensor) -> Tensor:
        """Return that of the point, [U, U]: prior, and disagreement of windows and episodes (`episode` [W]).

        Errors within a window are correlated, so a window counts as one observation (White, 1980).
        Shortcomings of the physics show as episodes that would each have another cart: the point moves when
        one is left out, which is the jackknife's variance (Tukey, 1958), to first order.
        """
        matrix, slopes, _ = self.reduced()
        inverse = torch.linalg.inv(matrix)
        sampled = inverse @ self.disagreement(slopes) @ inverse
        groups = episode.unique()
        if len(groups) < 2:
            return sampled
        carried = self.point_state @ torch.linalg.inv(self.state_state)
        per_window = self.point_points - carried @ self.point_state.mT
        moves = torch.stack(
            [
                torch.linalg.solve(matrix - per_window[own].sum(0), slopes[own].sum(0))
                for own in (episode == group for group in groups)
            ]
        )
        moves = moves - moves.mean(0)
        return sampled + (len(groups) - 1) / len(groups) * moves.mT @ moves


class Linearization(NamedTuple):
    """Residuals of each window and their derivatives."""

    residuals: Tensor  # [W, R]
    by_point: Tensor  # [W, R, U]
    by_state: Tensor  # [W, R, 4]

    @property
    def weights(self) -> Tensor:
        """Weights of squared residuals that touch Huber's cost, [W, R]."""
        return ROBUST / self.residuals.abs().clamp(min=ROBUST) / CORRELATED

    def normal_equations(self, point: Tensor, offset: Tensor) -> NormalEquations:
        """Return the quadratic that touches the cost, for initial states `offset` [4, W] off their guess."""
        weights, prior = self.weights.unsqueeze(-1), STATE_SPREAD**-2 / CORRELATED
        weighted_point, weighted_state = self.by_point * weights, self.by_state * weights
        residuals = self.residuals.unsqueeze(-1)
        return NormalEquations(
            point_points=weighted_point.mT @ self.by_point,
            point_state=weighted_point.mT @ self.by_state,
            state_state=weighted_state.mT @ self.by_state + torch.diag(prior),
            point_slopes=(weighted_point.mT @ residuals).squeeze(-1),
            prior_weights=prior_weights(point),
            prior_slope=prior_weights(point) * point,
            state_slope=(weighted_state.mT @ residuals).squeeze(-1) + offset.T * prior,
        )


class Match(NamedTuple):
    """A point and initial states with their costs, during the search and at its end."""

    point: Tensor  # [U]
    motion: Tensor  # [4, W], the initial states
    costs: Tensor  # [W], without the prior of the point

    @property
    def cost(self) -> float:
        """The cost of all windows and of the prior."""
        return float(self.costs.sum() + prior_cost(self.point))


class Matching:
    """The least-squares problem of W windows.

    `simulate` takes K points [U, K] and K initial states of each window [4, W, K] to positions [F, 2, W, K],
    m and rad; `measured` are such, [F, 2, W]. `scale` [2] scales residuals, and `guess` [4, W] are the
    initial states before the search. A point is prior to measurement 0 with standard deviation 1,
    and stays within `limits`, [U] each. `on_step` is called before each linearization.
    """

    def __init__(
        self,
        simulate: Callable[[Tensor, Tensor], Tensor],
        measured: Tensor,
        scale: Tensor,
        guess: Tensor,
        limits: tuple[Tensor, Tensor] | None = None,
        on_step: Callable[[], object] = lambda: None,
    ) -> None:
        self.simulate, self.measured, self.scale, self.guess = simulate, measured, scale, guess
        self.on_step = on_step
        self.limits = limits or (guess.new_empty(0), guess.new_empty(0))
        farthest = FARTHEST * STATE_SPREAD.unsqueeze(1)
        self.bounds = guess - farthest, guess + farthest

    @torch.inference_mode()
    def residuals(self, points: Tensor, motion: Tensor) -> Tensor:
        """Return scaled residuals [W, R, K] at `points` [U, K] with initial states `motion` [4, W, K]."""
        scaled = scaled_residuals(self.simulate(points, motion), self.measured.unsqueeze(-1), self.scale)
        return scaled.permute(2, 0, 1, 3).flatten(1, 2)

    def costs(self, points: Tensor, motion: Tensor) -> Tensor:
        """Return Huber's cost of each window [W, K] at `points` [U, K] with initial states [4, W, K]."""
        offset = (motion - self.guess.unsqueeze(2)) / STATE_SPREAD.reshape(4, 1, 1)
        return (huber(self.residuals(points, motion)).sum(1) + (offset**2).sum(0)) / CORRELATED

    def linearize(self, point: Tensor, motion: Tensor) -> Linearization:
        """Return the residuals and their differences: one simulation of U + 5 carts per window."""
        self.on_step()
        size = len(point)
        moves = torch.block_diag(POINT_STEP * torch.eye(size, dtype=point.dtype), torch.diag(STATE_STEP))
        moves = torch.cat((moves.new_zeros(size + 4, 1), moves), 1)  # [U + 4, U + 5]
        points = point.unsqueeze(1) + moves[:size]
        motions = motion.unsqueeze(2) + moves[size:].unsqueeze(1)
        residuals = self.residuals(points, motions)
        slopes = (residuals[..., 1:] - residuals[..., :1]) / moves[:, 1:].diagonal()
        return Linearization(residuals[..., 0], slopes[..., :size], slopes[..., size:])

    def normal_equations(self, point: Tensor, motion: Tensor) -> NormalEquations:
        """Return the quadratic that touches the cost at a point and initial states."""
        return self.linearize(point, motion).normal_equations(point, motion - self.guess)

    def minimize(self, point: Tensor, motion: Tensor, iterations: int) -> Match:
        """Search by Levenberg-Marquardt from a point and initial states.

        Steps of initial states overshoot near sticking. So each window has a damping of its own, besides the
        point's, and keeps its state where the step would not lower its cost.
        """
        costs = self.costs(point.unsqueeze(1), motion.unsqueeze(2))[:, 0]
        now = Match(point, motion, costs)
        damping, own = FIRST_DAMPING, torch.full_like(costs, FIRST_DAMPING)
        for _ in range(iterations):
            normal, before = self.normal_equations(now.point, now.motion), now
            for _ in range(ATTEMPTS):
                trial, moved, factor = self.best_trial(before, normal, damping, own)
                own = torch.where(moved, own * factor / EASED, own * KEPT).clamp(LEAST_DAMPING, MOST_DAMPING)
                if trial.cost < before.cost:
                    now, damping = trial, max(LEAST_DAMPING, damping * factor / EASED)
                    break
                damping *= max(FACTORS) ** 2
            if now is before:
                break
            if len(point) and damping <= SETTLED_DAMPING:
                slow = before.cost - now.cost < CONVERGED * before.cost
                if slow or normal.length(now.point - before.point) < SETTLED:
                    break
        return now

    def best_trial(
        self, now: Match, normal: NormalEquations, damping: float, own: Tensor
    ) -> tuple[Match, Tensor, float]:
        """Return the best match after one step, the windows whose states moved, [W], and its factor.

        The dampings of the steps, all simulated side by side, are those given, times each of FACTORS.
        """
        steps = [normal.solve(damping * factor, own * factor) for factor in FACTORS]
        points = torch.stack([(now.point + step).clamp(*self.limits) for step, _ in steps], 1)
        motions = torch.stack([(now.motion + moves).clamp(*self.bounds) for _, moves in steps], 2)
        kept = now.motion.unsqueeze(2).expand_as(motions)
        costs, kept_costs = self.costs(points.repeat(1, 2), torch.cat((motions, kept), 2)).chunk(2, 1)
        matches = [
            Match(
                points[:, k],
                torch.where(costs[:, k] < kept_costs[:, k], motions[..., k], now.motion),
                torch.minimum(costs[:, k], kept_costs[:, k]),
            )
            for k in range(len(FACTORS))
        ]
        best = min(range(len(matches)), key=lambda k: matches[k].cost)
        return matches[best], costs[:, best] < kept_costs[:, best], FACTORS[best]


class InitialStates(NamedTuple):
    """The states in which windows start, and the cost of residuals once these states may follow them."""

    motion: Tensor  # [4, M, W]
    form: Tensor  # [M, W, R, R]: residuals r cost r' form r where the initial states are the best for them


@solvable()
def match_initial_states(
    dynamics: Dynamics,
    positions: Tensor,
    motors: Tensor,
    scale: Tensor,
    residual: Residual | None = None,
    start: Tensor | None = None,
    rounds: int = ROUNDS,
) -> InitialStates:
    """Return the initial states that lead nearest to `positions` [T + 1, 2, W], m and rad.

    `motors` [H + T, W] are motor values, `scale` [2] scales residuals; each member of `residual` has initial
    states of its own. The search is from `start` [4, M, W], or from the first guess. Components that the
    positions do not show, such as the speed of a cart that sticks at once, stay near that guess. Raises
    RecordingError.
    """
    members, windows = 1 if residual is None else residual.members, positions.shape[2]
    guess = first_guess(positions, dynamics.period).repeat(1, members)

    def simulate(points: Tensor, motion: Tensor) -> Tensor:
        variants = motion.shape[2]
        simulated = dynamics.positions(
            motion.reshape(4, members, -1), motors.repeat_interleave(variants, 1), residual
        )
        return simulated.reshape(len(positions), 2, -1, variants)

    problem = Matching(simulate, positions.repeat(1, 1, members), scale, guess)
    nothing = guess.new_empty(0)
    motion = problem.minimize(nothing, guess if start is None else start.flatten(1), rounds).motion
    linear = problem.linearize(nothing, motion)
    normal = linear.normal_equations(nothing, motion - guess)
    weighted = linear.by_state * linear.weights.unsqueeze(-1)
    form = torch.diag_embed(linear.weights) - weighted @ torch.linalg.solve(normal.state_state, weighted.mT)
    return InitialStates(motion.reshape(4, members, windows), form.unflatten(0, (members, windows)))
