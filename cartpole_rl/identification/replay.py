"""Recorded motor values drive a simulated cart, which is put back onto the recorded one at intervals.

Longer predictions cannot be compared: near upright an error grows e times in 0.15 s. Velocities are not
measured; the initial state of a stretch is the one whose simulated motion best matches the positions measured
in a lead of 0.1 s before it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.matching import match_initial_states
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import HISTORY, IRREGULAR
from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.physics.models import Models
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.upright import wrap

Array = NDArray[np.float64]
LEAD = 5  # periods before a stretch, whose positions give its initial state
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
    """Return each episode beside a cart of `parameters` that is put back onto it every `restart` s.

    `lead` is that of `rollout`.
    Raises RecordingError where an episode is of another rate than `period` s, or too short.
    """
    dynamics = Dynamics.of(parameters, models, period, substeps, lead)
    periods = max(1, round(restart / period))
    return [_replayed(episode, dynamics, periods) for episode in episodes]


def recorded_period(episode: Episode) -> float:
    """Return the control period of a recording, s: the median time between frames, to 0.1 ms."""
    return round(float(np.median(np.diff(episode.time))), 4)


def _replayed(episode: Episode, dynamics: Dynamics, periods: int) -> Replayed:
    period = dynamics.period
    gaps = np.diff(episode.time)
    if abs(np.median(gaps) / period - 1) > IRREGULAR:
        raise RecordingError(
            f"a recording has a frame every {np.median(gaps) * 1e3:.1f} ms, and not every "
            f"{period * 1e3:.1f} ms"
        )
    counts, motors, starts = _stretches(episode, gaps, period, periods)
    if not len(starts):
        raise RecordingError(
            f"a recording of {episode.steps * period:.2f} s is too short to be replayed, or its frames are "
            "late or lost"
        )

    every = torch.from_numpy(motors)
    lead = torch.from_numpy(counts[: LEAD + 1])
    first = match_initial_states(dynamics, lead, every[: HISTORY + LEAD]).motion
    measured = counts[LEAD:] * UNIT
    simulated = dynamics.counts(first, every).squeeze(2).numpy()[LEAD:] * UNIT
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


def _stretches(episode: Episode, gaps: Array, period: float, periods: int) -> tuple[Array, Array, NDArray]:
    """Return counts [LEAD + T + 1, 2, S], motor values [HISTORY + LEAD + T, S] and first rows [S].

    A stretch ends at the first late frame, and is left out if that frame is in its lead.
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
    return np.stack(positions, -1), np.stack(motors, -1), np.array(starts)
