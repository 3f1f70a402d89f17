"""Learns what the identified physics lacks: an ensemble of residuals, by matching trajectories.

Windows of recorded motion are predicted by physics and residual together, and gradients flow through the
whole window: the same encoder counts of positions as in the fit, no measured velocity, no one-step target.
Each window's beginning is a nuisance. Every so often it is found anew, by Levenberg-Marquardt, for the
residual as it is by then; in between, what a changed beginning could explain is projected out of the errors
(variable projection, as in the fit). With beginnings merely held, learning is several times as slow.

Members differ by their first weights and by what windows are worth to them, which is drawn for each (the
Bayesian bootstrap; Rubin, 1981). A share is worth nothing to a member: it keeps the weights with which it
predicts those best, and the zeros of its beginning count too.
What no window tells is drawn to zero: tables by a price on each place, networks by a price on their outputs
at random motions.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from cartpole_rl.identification.fit import ROBUST, SCALE, STATE_STEP
from cartpole_rl.identification.prediction import as_counts, run_actuator
from cartpole_rl.identification.settings import EnsembleSettings
from cartpole_rl.identification.windows import HISTORY, Windows
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.physics.residual import (
    INPUTS,
    UNDER_WAY,
    Addition,
    Residual,
    members_in_turn,
    run_corrected_period,
)
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT

FINEST = np.array([1.0, 0.4])  # counts: no residual is told from rounding below that
FARTHEST = 3.0  # of SPREAD: how far a beginning may lie from its first guess
GUESSED_FROM = 3  # positions, for the first guess of a beginning
ROUNDS, REFRESHING = 8, 2  # steps toward a beginning where there is none yet, and each time after that
BACKGROUND = 256  # random motions an update
MOVES = torch.from_numpy(STATE_STEP).reshape(4, 1, 1)
SPREAD = torch.tensor([5e-4, 0.5, 5e-3, 3.0], dtype=torch.float64).reshape(
    4, 1, 1
)  # of it: m, m/s, rad, rad/s
CORRELATED = 10.0  # residuals of one window resemble each other: so many say as much as one


@dataclass(frozen=True)
class Dynamics:
    """A cart of which copies are simulated, M members with W windows each."""

    cart: Tensor  # [P, 1] float64
    models: Models
    period: float  # s
    substeps: int

    @classmethod
    def of(cls, parameters: Mapping[str, float], models: Models, period: float, substeps: int) -> "Dynamics":
        """The cart of `parameters` by name."""
        table = [[float(parameters[name])] for name in CartParameters.names()]
        return cls(torch.tensor(table, dtype=torch.float64), models, period, substeps)

    def counts(self, motion: Tensor, motors: Tensor, residual: Residual | None) -> Tensor:
        """Counts [T + 1, 2, M, W], not rounded, from beginnings [4, M, W], motor values [HISTORY + T, W]."""
        members, windows = motion.shape[1:]
        cart = CartParameters.from_table(self.cart.expand(-1, members * windows))
        state = State(*motion.reshape(4, -1).unbind(0))
        force = torch.zeros_like(state.x)
        laws = (cart, self.models, self.period, self.substeps)
        addition = None if residual is None else members_in_turn(residual, windows)
        every = motors.repeat(1, members)
        counts = [as_counts(state, cart)]
        for now in range(UNDER_WAY - 1, len(every)):
            under_way = [every[now - age] for age in range(UNDER_WAY)]
            if now < HISTORY:
                force = run_actuator(force, under_way, *laws)
                continue
            state, force = self._period(state, Drive(force, under_way), cart, addition)
            counts.append(as_counts(state, cart))
        return torch.stack(counts).reshape(-1, 2, members, windows)

    def _period(
        self, state: State, drive: Drive, cart: CartParameters, addition: Addition | None
    ) -> tuple[State, Tensor]:
        laws = (cart.latency, cart, self.models, self.period, self.substeps)
        if addition is None:
            state, after = run_period(state, drive, *laws)
        else:
            state, after = run_corrected_period(state, drive, *laws, addition)
        return state, after.force


def first_guess(positions: Tensor, period: float) -> Tensor:
    """States [4, W] from a parabola through the first positions [T + 1, 2, W].

    Through no more than three: a motor that turns round bends the next ones away from any parabola.
    """
    known = positions[:GUESSED_FROM].numpy()
    time = np.arange(len(known)) * period
    (_, x_dot, x), (_, theta_dot, theta) = (np.polyfit(time, known[:, k], 2) for k in range(2))
    metres, radians = CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
    return torch.from_numpy(np.stack((x * metres, x_dot * metres, theta * radians, theta_dot * radians)))


class Beginnings(NamedTuple):
    """The states [4, M, W] that windows begin in, and what a residual means once they may follow it."""

    motion: Tensor  # [4, M, W]
    form: Tensor  # [M, W, R, R]: residuals r cost r' form r where the beginnings are the best for them


@torch.no_grad()
def best_beginnings(
    simulate: Callable[[Tensor], Tensor], measured: Tensor, guess: Tensor, motion: Tensor, rounds: int
) -> Beginnings:
    """The beginnings that lead nearest to `measured` [F, 2, W], scaled: Levenberg-Marquardt from `motion`.

    `simulate` takes beginnings [4, M, k W], W windows k times over, to scaled counts [F, 2, M, k W]; `guess`
    [4, W] is what is thought of them before. Each window has a damping of its own: where a cart sticks or
    not, steps overshoot.
    """
    guess = guess.unsqueeze(1)
    low, high = guess - FARTHEST * SPREAD, guess + FARTHEST * SPREAD
    touching = linearized(simulate, measured, motion, guess)
    damping = torch.full_like(touching.cost, 1e-3)
    for _ in range(rounds):
        trial = torch.minimum(torch.maximum(motion - touching.step(damping), low), high)
        there = linearized(simulate, measured, trial, guess)
        better = there.cost < touching.cost
        motion = torch.where(better, trial, motion)
        damping = torch.where(better, damping / 5, damping * 8)
        touching = Linearized(
            *(
                torch.where(better.reshape(*better.shape, *[1] * (new.dim() - 2)), new, old)
                for new, old in zip(there, touching, strict=True)
            )
        )
    return Beginnings(motion, touching.form())


class Linearized(NamedTuple):
    """The weighted residuals of each window about a beginning, and how they follow it."""

    cost: Tensor  # [M, W]
    residuals: Tensor  # [M, W, R]
    slopes: Tensor  # [M, W, R, 4]
    weights: Tensor  # [M, W, R], of Huber's cost
    strayed: Tensor  # [M, W, 4], in SPREAD

    def normal(self) -> Tensor:
        """The normal matrix [M, W, 4, 4]."""
        weighted = self.slopes * self.weights.unsqueeze(-1)
        return weighted.mT @ self.slopes + torch.diag(SPREAD.flatten() ** -2)

    def step(self, damping: Tensor) -> Tensor:
        """Levenberg-Marquardt's, with `damping` [M, W], to be taken off, [4, M, W]."""
        slope = torch.einsum("mwrs,mwr->mws", self.slopes, self.weights * self.residuals)
        slope = slope + self.strayed / SPREAD.flatten()
        normal = self.normal()
        normal = normal + torch.diag_embed(damping.unsqueeze(-1) * normal.diagonal(dim1=-2, dim2=-1))
        return torch.linalg.solve(normal, slope.unsqueeze(-1)).squeeze(-1).permute(2, 0, 1)

    def form(self) -> Tensor:
        """What is left of residuals, once the beginning has followed them, [M, W, R, R]."""
        weighted = self.slopes * self.weights.unsqueeze(-1)
        return torch.diag_embed(self.weights) - weighted @ torch.linalg.solve(self.normal(), weighted.mT)


def linearized(
    simulate: Callable[[Tensor], Tensor], measured: Tensor, motion: Tensor, guess: Tensor
) -> Linearized:
    """Residuals at `motion` [4, M, W] and their differences."""
    members, windows = motion.shape[1:]
    shifts = torch.cat((torch.zeros(4, 1, dtype=motion.dtype), torch.diag(MOVES.flatten())), 1)
    variants = motion.unsqueeze(2) + shifts.reshape(4, 1, 5, 1)  # [4, M, 5, W]
    counts = simulate(variants.reshape(4, members, -1)).reshape(-1, 2, members, 5, windows)
    error = (counts - measured[:, :, None, None]).nan_to_num(1e6, 1e6, -1e6)
    error = error.permute(2, 4, 3, 0, 1).reshape(members, windows, 5, -1)
    residuals = error[:, :, 0]
    slopes = (error[:, :, 1:] - error[:, :, :1]) / MOVES.reshape(4, 1)
    strayed = (motion - guess) / SPREAD
    return Linearized(
        huber(residuals).sum(-1) + (strayed**2).sum(0),
        residuals,
        slopes.mT,
        ROBUST / residuals.abs().clamp(min=ROBUST),
        strayed.permute(1, 2, 0),
    )


def huber(residuals: Tensor) -> Tensor:
    """Squares up to ROBUST, straight lines beyond."""
    size = residuals.abs()
    return torch.where(size < ROBUST, size**2, 2 * ROBUST * size - ROBUST**2)


class Ensemble:
    """The learning of one ensemble on one set of windows."""

    def __init__(
        self, windows: Windows, dynamics: Dynamics, scale: np.ndarray, settings: EnsembleSettings, seed: int
    ) -> None:
        self.dynamics, self.settings = dynamics, settings
        self.scale = torch.from_numpy(np.clip(scale, FINEST, SCALE)).reshape(2, 1)
        self.positions = torch.from_numpy(windows.positions)
        self.motors = torch.from_numpy(windows.motors)
        self.generator = torch.Generator().manual_seed(seed)
        members = settings.members
        draws = torch.rand(members, windows.number, generator=self.generator, dtype=torch.float64)
        self.left_out = draws.argsort(1).argsort(1) < settings.validation * windows.number  # [M, W]
        worth = -torch.rand(draws.shape, generator=self.generator, dtype=torch.float64).log()
        self.worth = worth * ~self.left_out  # [M, W], of each window to each member
        self.residual = Residual.untrained(members, settings.hidden, self.generator).as_type(torch.float64)
        self.guess = first_guess(self.positions, dynamics.period)
        self.beginnings = Beginnings(self.guess.unsqueeze(1).repeat(1, members, 1), torch.empty(0))
        self.best = self.residual
        self.lowest = torch.full((members,), torch.inf, dtype=torch.float64)
        self.history: list[list[float]] = []  # loss of each member on what it leaves out, at each refresh
        self.updates: list[int] = []  # made by then

    def learn(self, told: Callable[[int, list[float]], None] = lambda *_: None) -> Residual:
        """All updates; the members, each as it predicted best what it left out."""
        weights = [weight.clone().requires_grad_() for weight in self.residual]
        optimizer = torch.optim.Adam(weights, self.settings.learning_rate)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.settings.updates)
        self.residual = Residual(*weights)
        self.refresh(ROUNDS, 0)
        for update in range(1, self.settings.updates + 1):
            optimizer.zero_grad()
            self.cost().backward()
            torch.nn.utils.clip_grad_norm_(weights, 1e3)
            optimizer.step()
            falling.step()
            if update % self.settings.refresh == 0 or update == self.settings.updates:
                self.refresh(REFRESHING, update)
                told(update, self.history[-1])
        return self.best

    def refresh(self, rounds: int, update: int) -> None:
        """Find the beginnings anew, and keep the members that are better than they have ever been."""
        scale = self.scale

        def simulate(motion: Tensor) -> Tensor:
            motors = self.motors.repeat(1, motion.shape[2] // self.motors.shape[1])
            return self.dynamics.counts(motion, motors, self.residual) / scale.unsqueeze(-1)

        measured, before = self.positions / scale, self.beginnings.motion
        self.beginnings = best_beginnings(simulate, measured, self.guess, before, rounds)
        with torch.no_grad():
            error = huber(self.residuals()).mean(-1)
            missed = (error * self.left_out).sum(1) / self.left_out.sum(1)
            self.history.append(missed.tolist())
            self.updates.append(update)
            better = missed < self.lowest
            kept = [
                torch.where(better.reshape(-1, *[1] * (new.dim() - 1)), new, old).clone()
                for new, old in zip(self.residual, self.best, strict=True)
            ]
            self.best, self.lowest = Residual(*kept), torch.minimum(missed, self.lowest)

    def residuals(self) -> Tensor:
        """Scaled residuals from the beginnings as they are held, [M, W, R]."""
        predicted = self.dynamics.counts(self.beginnings.motion, self.motors, self.residual)
        error = (predicted - self.positions.unsqueeze(2)) / self.scale.unsqueeze(-1)
        return error.nan_to_num(1e6, 1e6, -1e6).permute(2, 3, 0, 1).flatten(2)

    def cost(self) -> Tensor:
        """What an update lowers: of windows that a member learns from, and of saying more than they tell."""
        residuals = self.residuals().unsqueeze(-1)
        left = (residuals.mT @ self.beginnings.form @ residuals).flatten(1) / CORRELATED  # [M, W]
        of_windows = (left * self.worth).sum()
        places = self.residual.places
        steps = places.diff(dim=1)
        of_places = self.settings.table_penalty * ((places**2).sum() + 10 * (steps**2).sum())
        outputs = self.residual.network(self.random_inputs())
        return of_windows + of_places + self.settings.output_penalty * (outputs**2).mean((1, 2)).sum()

    def random_inputs(self) -> Tensor:
        """Motions from anywhere, [1, INPUTS, BACKGROUND]; see `network_inputs`."""
        size = torch.tensor([1.0, 2.0, 1.0, 1.0, 2.0, 1.2, *[1.25] * UNDER_WAY], dtype=torch.float64)
        draws = torch.rand(INPUTS, BACKGROUND, generator=self.generator, dtype=torch.float64)
        inputs = size.unsqueeze(1) * (2 * draws - 1)
        angle = torch.pi * inputs[2]
        inputs[2], inputs[3] = torch.sin(angle), torch.cos(angle)
        return inputs.unsqueeze(0)
