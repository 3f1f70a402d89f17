"""Learns the errors of the identified physics: an ensemble of residuals, by matching trajectories.

Windows of recorded motion are predicted by physics and residual together, and gradients flow through the
whole window: the same positions as in the fit, no measured velocity, no one-step target.
Initial states of windows are nuisance parameters, matched again at intervals, for the current residual; in
between, any effect that a changed initial state could explain is projected out of the errors (variable
projection, as in the fit). With fixed initial states learning is several times slower.

Members differ by their first weights and by the weights of the windows, which are drawn for each (the
Bayesian bootstrap; Rubin, 1981). A share of the windows is left out for each member: it keeps the parameters
with which it predicts those best, zeros included.
Outputs that no window determines are drawn to zero: tables by a penalty on each entry, networks by a penalty
on their outputs at random motions.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.errors import LearningError, RecordingError
from cartpole_rl.identification.matching import (
    COARSE,
    ROUNDS,
    InitialStates,
    finest_scale,
    first_guess,
    huber,
    match_initial_states,
    scaled_residuals,
)
from cartpole_rl.identification.prediction import CERTAIN, LEAD, predicted_by_members
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.settings import EnsembleSettings
from cartpole_rl.identification.windows import Windows, lead_periods
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.physics.residual import Residual
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.tasks.episode import wrap

REFRESHING = 2  # matching steps in each refresh after the first
BACKGROUND = 256  # random motions per update
SHARE = 0.95  # of the errors that lie within CERTAIN spreads
WIDEST, HALVINGS = 6.0, 5  # factor on the distances between members; steps of the search for it


class Ensemble:
    """The learning of one ensemble on one set of windows, of a cart with `track_span` m between its stops.

    Raises RecordingError for a single window.
    """

    def __init__(
        self,
        windows: Windows,
        dynamics: Dynamics,
        scale: np.ndarray,
        settings: EnsembleSettings,
        seed: int,
        track_span: float,
    ) -> None:
        if windows.number < 2:
            raise RecordingError(
                "there is a single window to learn from: record longer, or give more windows"
            )
        self.dynamics, self.settings = dynamics, settings
        self.windows = windows._replace(lead=lead_periods(LEAD, dynamics.period))
        self.scale = torch.maximum(
            torch.from_numpy(scale).clamp(max=COARSE), finest_scale(windows.resolution)
        )
        self.positions = torch.from_numpy(windows.positions)
        self.motors = torch.from_numpy(windows.motors)
        self.generator = torch.Generator().manual_seed(seed)
        members = settings.members
        draws = torch.rand(members, windows.number, generator=self.generator, dtype=torch.float64)
        share = max(1, min(settings.validation * windows.number, windows.number - 1))
        self.left_out = draws.argsort(1).argsort(1) < share  # [M, W]; at least one is, and one is not
        weight = -torch.rand(draws.shape, generator=self.generator, dtype=torch.float64).log()
        self.weight = weight * ~self.left_out  # [M, W], of each window for each member
        largest = torch.tensor([float(LARGEST_MOTOR)], dtype=torch.float64)
        force = float(dynamics.models.actuator(largest, CartParameters(dynamics.cart)))
        self.residual = Residual.untrained(
            members, settings.hidden, self.generator, dynamics.period, force, track_span
        ).as_type(torch.float64)
        guess = first_guess(self.positions, dynamics.period)
        self.initial = InitialStates(guess.unsqueeze(1).repeat(1, members, 1), torch.empty(0))
        self.best = self.residual
        self.allowed: float | None = None  # share of the errors within the spreads; None without spreads
        self.lowest = torch.full((members,), torch.inf, dtype=torch.float64)
        self.history: list[list[float]] = []  # loss of each member on the windows left out, at each refresh
        self.updates: list[int] = []  # at each refresh

    def learn(self, on_refresh: Callable[[int, list[float]], None] = lambda *_: None) -> Residual:
        """Make all updates; return each member as it best predicted the windows left out.

        `on_refresh` is called with the number of updates and each member's loss on those windows. Raises
        LearningError if it diverges.
        """
        weights = [weight.clone().requires_grad_() for weight in self.residual.weights]
        optimizer = torch.optim.Adam(weights, self.settings.learning_rate)
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self.settings.updates)
        self.residual = self.residual.with_weights(weights)
        self.refresh(ROUNDS, 0)
        for update in range(1, self.settings.updates + 1):
            optimizer.zero_grad()
            cost = self.cost()
            check_finite(cost)
            cost.backward()
            torch.nn.utils.clip_grad_norm_(weights, 1e3)
            optimizer.step()
            falling.step()
            if update % self.settings.refresh == 0 or update == self.settings.updates:
                self.refresh(REFRESHING, update)
                on_refresh(update, self.history[-1])
        return self.best

    def calibrate(self, longer: Windows) -> Residual:
        """Move the best members apart until SHARE of their errors lie within their spread; return them.

        Judged are the windows that each member left out, at all times, and the ends of `longer` ones, where
        errors have grown: the cart's and the angle's each. If motion differs from the members' mean as they
        do from each other, a member differs from it by sqrt(2) spreads, and by the rounding of the encoders.
        Members are never moved nearer.
        """
        near, far = 1.0, WIDEST
        adds = self.best.places.any() or self.best.last.any()
        if not adds or self.settings.members == 1:
            return self.best
        self.allowed = self.covered(near, longer)
        if self.allowed < SHARE:
            self.allowed = self.covered(far, longer)
            for _ in range(HALVINGS):
                middle = (near + far) / 2
                share = self.covered(middle, longer)
                if share >= SHARE:
                    far, self.allowed = middle, share
                else:
                    near = middle
            self.best = self.best._replace(widening=torch.tensor(far, dtype=torch.float64))
        return self.best

    def covered(self, widening: float, longer: Windows) -> float:
        """Return the least share of the members' errors within CERTAIN spreads, of those judged."""
        residual = self.best._replace(widening=torch.tensor(widening, dtype=torch.float64))
        within = within_spreads(self.windows, self.dynamics, residual)
        left_out = within[np.broadcast_to(self.left_out.numpy(), within.shape)].mean()
        cart, angle = within_spreads(longer, self.dynamics, residual)[-1].mean((1, 2))
        return float(min(left_out, cart, angle))

    def refresh(self, rounds: int, update: int) -> None:
        """Match the initial states again, and keep each member that beats its best loss so far.

        Raises LearningError.
        """
        with torch.no_grad():
            check_finite(self.residuals())
        self.initial = match_initial_states(
            self.dynamics, self.positions, self.motors, self.scale, self.residual, self.initial.motion, rounds
        )
        with torch.no_grad():
            error = huber(self.residuals()).mean(-1)
        loss = (error * self.left_out).sum(1) / self.left_out.sum(1)
        self.history.append(loss.tolist())
        self.updates.append(update)
        better = loss < self.lowest
        kept = [
            torch.where(better.reshape(-1, *[1] * (new.dim() - 1)), new.detach(), old)
            for new, old in zip(self.residual.weights, self.best.weights, strict=True)
        ]
        self.best, self.lowest = self.best.with_weights(kept), torch.minimum(loss, self.lowest)

    def residuals(self) -> Tensor:
        """Return scaled residuals from the present initial states, [M, W, R]."""
        positions = self.dynamics.positions(self.initial.motion, self.motors, self.residual)
        error = scaled_residuals(positions, self.positions.unsqueeze(2), self.scale)
        return error.permute(2, 3, 0, 1).flatten(2)

    def cost(self) -> Tensor:
        """Return the loss of an update: errors in windows, and penalties."""
        residuals = self.residuals().unsqueeze(-1)
        errors = (residuals.mT @ self.initial.form @ residuals).flatten(1)  # [M, W]
        places = self.residual.places
        steps = places.diff(dim=1)
        table_penalty = self.settings.table_penalty * ((places**2).sum() + 10 * (steps**2).sum())
        outputs = self.residual.network(self.random_inputs())
        output_penalty = self.settings.output_penalty * (outputs**2).mean((1, 2)).sum()
        return (errors * self.weight).sum() + table_penalty + output_penalty

    def random_inputs(self) -> Tensor:
        """Return inputs of random motions, [1, I, BACKGROUND]; see `network_inputs`."""
        motors = [1.25] * self.residual.memory
        size = torch.tensor([1.0, 2.0, 1.0, 1.0, 2.0, 1.2, *motors], dtype=torch.float64)
        draws = torch.rand(len(size), BACKGROUND, generator=self.generator, dtype=torch.float64)
        inputs = size.unsqueeze(1) * (2 * draws - 1)
        angle = torch.pi * inputs[2]
        inputs[2], inputs[3] = torch.sin(angle), torch.cos(angle)
        return inputs.unsqueeze(0)


def within_spreads(windows: Windows, dynamics: Dynamics, residual: Residual) -> NDArray[np.bool_]:
    """Return where each member's errors [H, 2, M, W] after the lead lie within CERTAIN spreads."""
    _, errors = predicted_by_members(windows, dynamics, residual)
    errors = errors[1:]
    spread = errors.std(2, ddof=1, keepdims=True)
    errors[:, 1] = wrap(errors[:, 1])
    rounding = finest_scale(windows.resolution).numpy().reshape(1, 2, 1, 1)
    return np.asarray(np.abs(errors) <= CERTAIN * np.sqrt(2 * spread**2 + rounding**2))


def check_finite(numbers: Tensor) -> None:
    """Raise LearningError if one of the numbers is not finite."""
    if not numbers.isfinite().all():
        raise LearningError("learning diverged; try a smaller ensemble.learning_rate")
