"""What a model predicts of motion that it did not learn from, and whether it knows how wrong it is.

A window begins with LEAD periods in which its beginning is found, by the model that is judged; from there on
it predicts without looking. Nothing after the lead has a part in where it starts.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from cartpole_rl.identification.learned import FINEST, Dynamics, best_beginnings, first_guess
from cartpole_rl.identification.windows import HISTORY, Windows
from cartpole_rl.physics.residual import Residual
from cartpole_rl.tasks.features import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.tasks.upright import wrap

LEAD = 10  # periods
ROUNDS = 10  # steps toward a beginning
CERTAIN = 2.0  # spreads that should hold about 95 % of the errors
UNIT = np.array([CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT]).reshape(2, 1)  # m, rad

Array = NDArray[np.float64]


class Prediction(NamedTuple):
    """Errors of one model over H periods after the lead: simulated minus measured."""

    error: Array  # [H + 1, 2, W] m, rad, of the members' mean
    spread: Array  # [H + 1, 2, W] m, rad, standard deviation among the members; 0 for physics alone


def predict_held_out(windows: Windows, dynamics: Dynamics, residual: Residual | None) -> Prediction:
    """Predict every window of LEAD + H periods after its lead, with each member of `residual`."""
    members = 1 if residual is None else residual.members
    positions = torch.from_numpy(windows.positions)
    motors = torch.from_numpy(windows.motors)
    guess = first_guess(positions, dynamics.period)
    scale = torch.from_numpy(FINEST).reshape(2, 1)
    lead = motors[: HISTORY + LEAD]

    def simulate(motion: torch.Tensor) -> torch.Tensor:
        every = lead.repeat(1, motion.shape[2] // windows.number)
        return dynamics.counts(motion, every, residual) / scale.unsqueeze(-1)

    start = guess.unsqueeze(1).repeat(1, members, 1)
    found = best_beginnings(simulate, positions[: LEAD + 1] / scale, guess, start, ROUNDS).motion
    with torch.no_grad():
        counts = dynamics.counts(found, motors, residual)[LEAD:].numpy()  # [H + 1, 2, M, W]
    error = (counts - windows.positions[LEAD:, :, None]) * UNIT[..., None]
    error[:, 1] = wrap(error[:, 1])
    spread = error.std(2, ddof=1) if members > 1 else np.zeros_like(error[:, :, 0])
    return Prediction(error.mean(2), spread)


def errors_at(prediction: Prediction, moments: Sequence[float], period: float) -> list[dict[str, Any]]:
    """RMS and median of the errors at `moments` s after the lead, and of the spread beside them."""
    told = []
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
        told.append(line)
    return told
