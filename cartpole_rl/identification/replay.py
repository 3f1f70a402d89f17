"""Recorded motor values drive a simulated cart, which is put where the recorded one was every so often.

Over ten seconds nothing could be compared: near upright an error grows e times in 0.15 s. Where a stretch
begins, velocities are not measured; the state there is the one that the simulator's own motion of the 0.1 s
before leads to, once its beginning is fitted to the positions measured in them.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.fit import STATE_SPREAD, STATE_STEP
from cartpole_rl.identification.prediction import predict
from cartpole_rl.identification.windows import HISTORY, IRREGULAR
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.tasks.upright import wrap

Array = NDArray[np.float64]
LEAD = 5  # periods before a stretch, from whose positions its first state is found
ROUNDS = 3  # of Gauss-Newton; the second hardly changes anything
FARTHEST = 3.0  # of STATE_SPREAD: how far a beginning may lie from its first guess
UNIT = np.array([CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT])[:, None]  # m, rad


class Replayed(NamedTuple):
    """One episode beside its replay in S stretches of T periods; NaN where a stretch ends early."""

    episode: Episode
    time: Array  # [S, T + 1] s
    x: Array  # [S, T + 1] m, simulated
    theta: Array  # [S, T + 1] rad, simulated, not wrapped
    x_error: Array  # [S, T + 1] m, simulated minus measured
    theta_error: Array  # [S, T + 1] rad, wrapped


def replay(
    episodes: Sequence[Episode],
    parameters: Mapping[str, float],
    models: Models,
    period: float,
    substeps: int,
    restart: float,
    lead: float = 0.0,
) -> list[Replayed]:
    """Each episode beside a cart of `parameters` that is put back onto it every `restart` s.

    `lead` is that of `predict`.
    Raises RecordingError where an episode is of another rate than `period` s, or too short.
    """
    cart = torch.tensor([[float(parameters[name])] for name in CartParameters.names()], dtype=torch.float64)
    periods = max(1, round(restart / period))
    return [
        _replayed(episode, _Simulation(cart, models, period, substeps, lead), periods) for episode in episodes
    ]


def recorded_period(episode: Episode) -> float:
    """The control period of a recording, s: the median time between frames, to 0.1 ms."""
    return round(float(np.median(np.diff(episode.time))), 4)


def _replayed(episode: Episode, run: "_Simulation", periods: int) -> Replayed:
    period = run.period
    gaps = np.diff(episode.time)
    if abs(np.median(gaps) / period - 1) > IRREGULAR:
        raise RecordingError(
            f"a recording has a frame every {np.median(gaps) * 1e3:.1f} ms, and not every "
            f"{period * 1e3:.1f} ms"
        )
    positions, motors, starts = _stretches(episode, gaps, period, periods)
    if not len(starts):
        raise RecordingError(
            f"a recording of {episode.steps * period:.2f} s is too short to be replayed, or its frames are "
            "late or lost"
        )

    first = _beginnings(positions[: LEAD + 1], motors[: HISTORY + LEAD], run)
    simulated, measured = run(first, motors)[LEAD:], positions[LEAD:]
    simulated = np.where(np.isnan(measured), np.nan, simulated)
    error = simulated - measured
    time = episode.time[starts + LEAD] + np.arange(periods + 1)[:, None] * period
    return Replayed(
        episode,
        time.T,
        simulated[:, 0].T,
        simulated[:, 1].T,
        error[:, 0].T,
        wrap(error[:, 1]).T,
    )


class _Simulation(NamedTuple):
    """Called with beginnings [4, S] and motor values [HISTORY + T, S]: positions [T + 1, 2, S] in m, rad."""

    cart: torch.Tensor  # [P, 1]
    models: Models
    period: float
    substeps: int
    lead: float

    def __call__(self, motion: Array, motors: Array) -> Array:
        table, laws = (
            self.cart.expand(-1, motion.shape[1]),
            (self.models, self.period, self.substeps, self.lead),
        )
        return predict(table, torch.from_numpy(motion), torch.from_numpy(motors), *laws).numpy() * UNIT


def _beginnings(measured: Array, motors: Array, run: _Simulation) -> Array:
    """States [4, S] whose simulated motion is nearest to positions [LEAD + 1, 2, S]: Gauss-Newton.

    What the positions do not tell, as the speed of a cart that sticks at once, stays at its first guess,
    which a parabola gives.
    """
    time = np.arange(len(measured)) * run.period
    (_, x_dot, x), (_, theta_dot, theta) = (np.polyfit(time, measured[:, k], 2) for k in range(2))
    guess = np.stack((x, x_dot, theta, theta_dot))
    farthest, doubt = FARTHEST * STATE_SPREAD[:, None], 1 / STATE_SPREAD**2
    moved = np.concatenate((np.zeros((4, 1)), np.diag(STATE_STEP)), 1)[..., None]  # [4, 5, 1]
    motion = guess
    for _ in range(ROUNDS):
        variants = (motion[:, None] + moved).reshape(4, -1)
        error = run(variants, np.tile(motors, (1, 5))) - np.tile(measured, (1, 1, 5))
        residuals = (error / UNIT).reshape(-1, 5, motion.shape[1])  # counts, [2 (LEAD + 1), 5, S]
        slopes = (residuals[:, 1:] - residuals[:, :1]) / STATE_STEP[:, None]
        normal = np.einsum("kis,kjs->sij", slopes, slopes) + np.diag(doubt)
        slope = np.einsum("kis,ks->si", slopes, residuals[:, 0]) + doubt * (motion - guess).T
        step = np.linalg.solve(normal, slope[..., None])[..., 0].T
        motion = np.clip(motion - step, guess - farthest, guess + farthest)
    return motion


def _stretches(episode: Episode, gaps: Array, period: float, periods: int) -> tuple[Array, Array, NDArray]:
    """Positions [LEAD + T + 1, 2, S] in m and rad, motor values [HISTORY + LEAD + T, S], first rows [S].

    A stretch ends at the first late frame, and is left out if that comes before it has begun.
    """
    length = LEAD + periods
    regular = np.abs(gaps / period - 1) < IRREGULAR
    padded = np.concatenate((np.zeros(HISTORY), episode.motor, np.zeros(length)))
    positions, motors, starts = [], [], []
    for start in range(0, episode.steps - LEAD, periods):
        row = np.full((length + 1, 2), np.nan)
        kept = episode.counts[start : start + length + 1]
        late = np.flatnonzero(~regular[start : start + length])
        known = min(len(kept), 1 + late[0] if len(late) else len(kept))
        if known > LEAD + 1:
            row[:known] = kept[:known]
            positions.append(row)
            motors.append(padded[start : start + HISTORY + length])
            starts.append(start)
    if not starts:
        return np.empty((length + 1, 2, 0)), np.empty((HISTORY + length, 0)), np.empty(0, dtype=np.int64)
    return np.stack(positions, -1) * UNIT, np.stack(motors, -1), np.array(starts)
