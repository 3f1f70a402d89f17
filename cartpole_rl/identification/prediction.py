"""Predictions of recorded motion, and their errors beside the spread of an ensemble's members.

The positions in the lead of a window give its initial state, under the model that is judged. Nothing after
the lead affects where a prediction starts.

A replay predicts a whole recording: the simulated cart is put back onto the measured one at intervals, since
near upright an error grows e times in 0.15 s.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.identification.matching import finest_scale, match_initial_states
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import Windows, cut_stretches, joined, lead_periods, naming
from cartpole_rl.physics.residual import Residual
from cartpole_rl.tasks.episode import Episode, wrap

CERTAIN = 2.0  # spreads that should hold about 95 % of the errors
REPORTED = {"x_mm": 1e3, "theta_deg": 180 / np.pi}  # names of the errors in reports: factor from m and rad
LEAD = 0.1  # s before a stretch of a replay
AWAY = 0.6  # rad from upright; nearer to it, an error grows e times in 0.15 s for any cart

Array = NDArray[np.float64]


class Prediction(NamedTuple):
    """Motion predicted by one model over H periods after the lead, in m and rad; NaN where not measured."""

    simulated: Array  # [H + 1, 2, W] mean of the members as they were learned, angles not wrapped
    error: Array  # [H + 1, 2, W] mean of these members: simulated minus measured
    spread: Array  # [H + 1, 2, W] standard deviation among the members, moved apart; 0 for physics alone


def predict(windows: Windows, dynamics: Dynamics, residual: Residual | None = None) -> Prediction:
    """Predict every window after its lead, with each member of `residual`."""
    simulated, error = predicted_by_members(windows, dynamics, residual and residual.not_widened())
    apart = error
    if residual is not None and residual.widening != 1:
        _, apart = predicted_by_members(windows, dynamics, residual)
    spread = apart.std(2, ddof=1) if apart.shape[2] > 1 else np.zeros_like(apart[:, :, 0])
    mean = error.mean(2)
    mean[:, 1] = wrap(mean[:, 1])
    return Prediction(simulated.mean(2), mean, spread)


def predicted_by_members(
    windows: Windows, dynamics: Dynamics, residual: Residual | None = None
) -> tuple[Array, Array]:
    """Return the motion that each member predicts after the lead, and its error, [H + 1, 2, M, W] each.

    The angle's error of the first member is wrapped, and each other one is the nearest to that.
    """
    lead, motors = windows.lead, torch.from_numpy(windows.motors)
    history = len(motors) - windows.periods
    positions = torch.from_numpy(windows.positions[: lead + 1])
    scale, driven = finest_scale(windows.resolution), motors[: history + lead]
    first = match_initial_states(dynamics, positions, driven, scale, residual).motion
    with torch.inference_mode():
        predicted = dynamics.positions(first, motors, residual)[lead:].numpy()  # [H + 1, 2, M, W]
    measured = windows.positions[lead:, :, None]
    simulated = np.where(np.isnan(measured), np.nan, predicted)
    error = simulated - measured
    first_angle = wrap(error[:, 1, :1])
    error[:, 1] = first_angle + wrap(error[:, 1] - first_angle)
    return simulated, error


def errors_at(
    error: Array, times: Sequence[float], period: float, spread: Array | None = None
) -> list[dict[str, Any]]:
    """Return RMS and median of the absolute errors at those `times`, s after the lead, that windows reach.

    `after_s` of each is the time of the period that is nearest, to two digits.
    `error` [H + 1, 2, W] is that of a Prediction; with its `spread`, the same of the spread is added, and the
    share of errors within CERTAIN spreads.
    """
    lines = []
    for time in times:
        row = round(time / period)
        if row >= len(error) or not (known := np.isfinite(error[row]).all(0)).any():
            continue
        line: dict[str, Any] = {"after_s": float(f"{row * period:.2g}"), "windows": int(known.sum())}
        for channel, (name, factor) in enumerate(REPORTED.items()):
            size = factor * np.abs(error[row, channel, known])
            line |= _summary(name, size)
            if spread is not None:
                each = factor * spread[row, channel, known]
                line |= _summary(f"spread_{name}", each)
                line[f"within_{name}"] = float((size <= CERTAIN * each).mean())
        lines.append(line)
    return lines


def _summary(name: str, sizes: Array) -> dict[str, float]:
    return {f"rms_{name}": float(root_mean_square(sizes)), f"median_{name}": float(np.median(sizes))}


def root_mean_square(values: Array) -> Array:
    """Return the RMS of the finite values over the last axis; NaN where there are none."""
    known = np.isfinite(values)
    count, total = known.sum(-1), (np.where(known, values, 0.0) ** 2).sum(-1)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))


class Replayed(NamedTuple):
    """One episode beside its replay in S stretches of T periods; NaN where a stretch ends early."""

    episode: Episode
    time: Array  # [S, T + 1] s
    x: Array  # [S, T + 1] m, simulated
    theta: Array  # [S, T + 1] rad, simulated, not wrapped
    x_error: Array  # [S, T + 1] m, simulated minus measured
    theta_error: Array  # [S, T + 1] rad, wrapped

    def rows(self) -> NDArray[np.intp]:
        """Return the row of the episode for each time, [S, T + 1]; its stamps may jitter."""
        period = self.time[0, 1] - self.time[0, 0]
        return np.searchsorted(self.episode.time, self.time - period / 2)


def replay(recordings: Mapping[str, Episode], dynamics: Dynamics, restart: float) -> list[Replayed]:
    """Return each recording beside the cart of `dynamics`, which is put back onto it every `restart` s.

    All run at once. Raises RecordingError, with the name of the file, for one that is too short.
    """
    cut, lead = [], lead_periods(LEAD, dynamics.period)
    for file, episode in recordings.items():
        with naming(file):
            cut.append(cut_stretches(episode, dynamics.period, restart, lead))
    simulated, error, _ = predict(joined(cut), dynamics)
    steps = np.arange(len(simulated)) * dynamics.period
    ends = np.cumsum([windows.number for windows in cut])
    replays = []
    for episode, windows, end in zip(recordings.values(), cut, ends, strict=True):
        own = slice(end - windows.number, end)
        time = episode.time[windows.first + windows.lead][:, None] + steps
        motion = (each[:, channel, own].T for each in (simulated, error) for channel in range(2))
        replays.append(Replayed(episode, time, *motion))
    return replays


def all_errors(replays: Sequence[Replayed]) -> Array:
    """Return the errors of all stretches in m and rad, [T + 1, 2, S], as in a Prediction."""
    errors = zip(*((each.x_error, each.theta_error) for each in replays), strict=True)
    return np.stack([np.concatenate(each).T for each in errors], 1)


def away_from_upright(replayed: Replayed) -> NDArray[np.bool_]:
    """Return the complete stretches, [S], in which the measured pole stays AWAY from upright."""
    return np.isfinite(replayed.x_error).all(1) & is_away(replayed.theta - replayed.theta_error)


def is_away(theta: Array) -> NDArray[np.bool_]:
    """Return True, [S], for angles [S, T + 1], rad, that stay AWAY from upright; NaN counts as hanging."""
    angle = np.abs(wrap(np.where(np.isfinite(theta), theta, np.pi)))
    return np.all(angle > AWAY, axis=1)
