"""Errors of a model's predictions of motion that it did not learn from, beside the spread of its members.

A window starts with LEAD periods whose positions give its initial state, under the model that is judged. From
there on the model predicts without looking: nothing after the lead affects where it starts.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.identification.matching import match_initial_states
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.windows import HISTORY, Windows
from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.physics.residual import Residual
from cartpole_rl.tasks.upright import wrap

LEAD = 10  # periods
CERTAIN = 2.0  # spreads that should hold about 95 % of the errors
UNIT = np.array([CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT]).reshape(2, 1)  # m, rad

Array = NDArray[np.float64]


class Prediction(NamedTuple):
    """Errors of one model over H periods after the lead: simulated minus measured."""

    error: Array  # [H + 1, 2, W] m, rad, of the members' mean
    spread: Array  # [H + 1, 2, W] m, rad, standard deviation among the members; 0 for physics alone


def predict_held_out(windows: Windows, dynamics: Dynamics, residual: Residual | None) -> Prediction:
    """Predict every window of LEAD + H periods after its lead, with each member of `residual`."""
    motors = torch.from_numpy(windows.motors)
    lead = torch.from_numpy(windows.positions[: LEAD + 1])
    first = match_initial_states(dynamics, lead, motors[: HISTORY + LEAD], residual).motion
    with torch.no_grad():
        counts = dynamics.counts(first, motors, residual)[LEAD:].numpy()  # [H + 1, 2, M, W]
    error = (counts - windows.positions[LEAD:, :, None]) * UNIT[..., None]
    error[:, 1] = wrap(error[:, 1])
    spread = error.std(2, ddof=1) if error.shape[2] > 1 else np.zeros_like(error[:, :, 0])
    return Prediction(error.mean(2), spread)


def errors_at(prediction: Prediction, moments: Sequence[float], period: float) -> list[dict[str, Any]]:
    """Return RMS and median of the errors and of the spread, for each of `moments`, s after the lead."""
    rows = []
    for moment in moments:
        row = round(moment / period)
        line: dict[str, Any] = {"after_s": moment, "windows": prediction.error.shape[2]}
        for channel, (name, factor) in enumerate({"x_mm": 1e3, "theta_deg": 180 / np.pi}.items()):
            error = factor * prediction.error[row, channel]
            spread = factor * prediction.spread[row, channel]
            line[f"rms_{name}"] = float(np.sqrt((error**2).mean()))
            line[f"median_{name}"] = float(np.median(np.abs(error)))
            line[f"rms_spread_{name}"] = float(np.sqrt((spread**2).mean()))
            line[f"median_spread_{name}"] = float(np.median(spread))
            line[f"within_{name}"] = float((np.abs(error) <= CERTAIN * spread).mean())
        rows.append(line)
    return rows
