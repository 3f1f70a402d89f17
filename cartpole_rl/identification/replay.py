"""Replay of recorded motor values on a simulated cart, which is reset to the measured state at intervals.

Longer predictions cannot be compared: near upright an error grows e times in 0.15 s. Velocities are not
measured; the initial state of a stretch is the one whose simulated motion best matches the positions measured
in the lead before it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.identification.prediction import predict
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import cut_stretches, lead_periods
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.upright import wrap

LEAD = 0.1  # s before a stretch
AWAY = 0.6  # rad from upright; nearer to it, an error grows e times in 0.15 s for any cart

Array = NDArray[np.float64]


class Replayed(NamedTuple):
    """One episode beside its replay in S stretches of T periods; NaN where a stretch ends early."""

    episode: Episode
    time: Array  # [S, T + 1] s
    x: Array  # [S, T + 1] m, simulated
    theta: Array  # [S, T + 1] rad, simulated, not wrapped
    x_error: Array  # [S, T + 1] m, simulated minus measured
    theta_error: Array  # [S, T + 1] rad, wrapped


def replay(episodes: Sequence[Episode], dynamics: Dynamics, restart: float) -> list[Replayed]:
    """Return each episode beside the cart of `dynamics`, which is put back onto it every `restart` s.

    Raises RecordingError where an episode has another control period than `dynamics`, or is too short.
    """
    return [_replayed(episode, dynamics, restart) for episode in episodes]


def _replayed(episode: Episode, dynamics: Dynamics, restart: float) -> Replayed:
    period = dynamics.period
    windows = cut_stretches(episode, period, restart, lead_periods(LEAD, period))
    simulated, error, _ = predict(windows, dynamics)
    starts = episode.time[windows.first + windows.lead]
    time = starts[:, None] + np.arange(len(simulated)) * period
    return Replayed(episode, time, simulated[:, 0].T, simulated[:, 1].T, error[:, 0].T, error[:, 1].T)


def all_errors(replays: Sequence[Replayed]) -> Array:
    """Return the errors of all stretches in m and rad, [T + 1, 2, S], as in a Prediction."""
    return np.stack(
        (
            np.concatenate([each.x_error for each in replays]).T,
            np.concatenate([each.theta_error for each in replays]).T,
        ),
        1,
    )


def away_from_upright(replayed: Replayed) -> NDArray[np.bool_]:
    """Return the complete stretches, [S], in which the measured pole stays AWAY from upright."""
    return np.isfinite(replayed.x_error).all(1) & is_away(replayed.theta - replayed.theta_error)


def is_away(theta: Array) -> NDArray[np.bool_]:
    """Return True, [S], for angles [S, T + 1], rad, that stay AWAY from upright; NaN counts as hanging."""
    angle = np.abs(wrap(np.where(np.isfinite(theta), theta, np.pi)))
    return np.all(angle > AWAY, axis=1)
