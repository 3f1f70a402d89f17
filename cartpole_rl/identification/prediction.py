"""Predictions of recorded motion, and their errors beside the spread of an ensemble's members.

The positions in the lead of a window give its initial state, under the model that is judged. Nothing after
the lead affects where a prediction starts.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.identification.matching import match_initial_states
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import Windows
from cartpole_rl.physics.residual import Residual
from cartpole_rl.rig.hardware import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.tasks.upright import wrap

CERTAIN = 2.0  # spreads that should hold about 95 % of the errors
PER_COUNT = np.array([CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT]).reshape(2, 1)  # m, rad
REPORTED = {"x_mm": 1e3, "theta_deg": 180 / np.pi}  # names of the errors in reports: factor from m and rad

Array = NDArray[np.float64]


class Prediction(NamedTuple):
    """Motion predicted by one model over H periods after the lead, in m and rad; NaN where not measured."""

    simulated: Array  # [H + 1, 2, W] mean of the members, angles not wrapped
    error: Array  # [H + 1, 2, W] mean of the members: simulated minus measured
    spread: Array  # [H + 1, 2, W] standard deviation among the members; 0 for physics alone


def predict(windows: Windows, dynamics: Dynamics, residual: Residual | None = None) -> Prediction:
    """Predict every window after its lead, with each member of `residual`."""
    lead, motors = windows.lead, torch.from_numpy(windows.motors)
    history = len(motors) - windows.periods
    positions = torch.from_numpy(windows.positions[: lead + 1])
    first = match_initial_states(dynamics, positions, motors[: history + lead], residual).motion
    with torch.no_grad():
        counts = dynamics.counts(first, motors, residual)[lead:].numpy()  # [H + 1, 2, M, W]
    measured = (windows.positions[lead:] * PER_COUNT)[:, :, None]
    simulated = np.where(np.isnan(measured), np.nan, counts * PER_COUNT[..., None])
    error = simulated - measured
    error[:, 1] = wrap(error[:, 1])
    spread = error.std(2, ddof=1) if error.shape[2] > 1 else np.zeros_like(error[:, :, 0])
    return Prediction(simulated.mean(2), error.mean(2), spread)


def errors_at(
    error: Array, times: Sequence[float], period: float, spread: Array | None = None
) -> list[dict[str, Any]]:
    """Return RMS and median of the absolute errors at those `times`, s after the lead, that windows reach.

    `error` [H + 1, 2, W] is that of a Prediction; with its `spread`, the same of the spread is added, and the
    share of errors within CERTAIN spreads.
    """
    lines = []
    for time in times:
        row = round(time / period)
        if row >= len(error) or not (known := np.isfinite(error[row]).all(0)).any():
            continue
        line: dict[str, Any] = {"after_s": time, "windows": int(known.sum())}
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
