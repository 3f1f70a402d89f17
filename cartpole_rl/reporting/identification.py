"""Page, figures and tables of an identification."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.identification.experiments import EXPERIMENTS, HELD_OUT
from cartpole_rl.identification.identify import HORIZON, Candidate, Identification, PredictionError
from cartpole_rl.identification.prediction import replay
from cartpole_rl.identification.quantities import Quantity, intervals
from cartpole_rl.reporting.curves import force_curve, friction_curve
from cartpole_rl.reporting.figures.identified import (
    experiments_figure,
    friction_and_force_figure,
    interval_figure,
    spectrum_figure,
)
from cartpole_rl.reporting.page import page
from cartpole_rl.reporting.table import interval_text, number_text, table
from cartpole_rl.run_folder import FIGURES
from cartpole_rl.tasks.episode import Episode

Array = NDArray[np.floating]
CAPTIONS = {  # figures/<name>.png: caption
    "friction_and_force": "Friction of the cart and force of the motor, with 95 % bands",
    "intervals": "Identified values with 95 % intervals, and prior values",
    "experiments": "The experiments, measured and simulated; the simulated cart is reset to the measured "
    "state every second",
    "held_out": "The held-out experiment, which was not used in the fit",
    "spectrum": "Remaining uncertainty of each combination of parameters, relative to the prior",
}


def quantities_table(quantities: Sequence[Quantity]) -> str:
    """Return the identified quantities as a table for the terminal."""
    rows = [
        {"name": each.words, "value": interval_text(each.value, each.low, each.high), "unit": each.unit}
        for each in quantities
    ]
    return table(rows, {"name": "quantity", "value": "value, 95 % interval", "unit": "unit"})


def error_text(error: PredictionError) -> str:
    """Return the errors of a prediction with their units."""
    return f"{1e3 * error.x:.2f} mm and {math.degrees(error.theta):.2f} deg"


def identification_figures(
    found: Identification, carts: Array, fitted: Mapping[str, Episode]
) -> dict[str, Figure]:
    """Return the figures of CAPTIONS; `carts` [P, N] are drawn from the fit to the `fitted` recordings."""
    fit, models = found.fit, found.models
    replays = replay([*fitted.values()], found.dynamics, HORIZON)
    return {
        "friction_and_force": friction_and_force_figure(
            friction_curve(fit.parameters, carts, fit.nominal, models.cart_friction),
            force_curve(fit.parameters, carts, fit.nominal, models.actuator),
        ),
        "intervals": interval_figure(intervals(fit, carts)),
        "experiments": experiments_figure(dict(zip(fitted, replays, strict=True))),
        "held_out": experiments_figure({HELD_OUT: found.held_out[0]}),
        "spectrum": spectrum_figure(fit.covariance, [unknown.name for unknown in fit.unknowns]),
    }


def identification_page(
    found: Identification,
    quantities: Sequence[Quantity],
    fitted: Mapping[str, Episode],
    next_command: str,
) -> str:
    """Return the HTML page of an identification, which shows the figures of CAPTIONS in figures/."""
    sections: list[tuple[str, Any]] = [
        ("Recordings", _recording_rows(fitted, found.dynamics.period)),
        ("Identified values", _quantity_rows(quantities)),
        ("Friction models of the cart", _friction_rows(found.candidates)),
        (
            "",
            "The table's errors are those over seconds of the recordings that were left out of these fits. "
            "RMS prediction error over one second of held-out motion away from upright, with the best model: "
            f"{error_text(found.error)}.",
        ),
        ("Warnings", found.warnings or ["None."]),
        ("Next step: train on carts like this one", [f"<code>{next_command}</code>"]),
        *[(caption, Path(FIGURES) / f"{name}.png") for name, caption in CAPTIONS.items()],
    ]
    return page("Identification of a cart", sections)


def _recording_rows(recordings: Mapping[str, Episode], period: float) -> list[dict[str, str]]:
    purposes = {experiment.name: experiment.shows for experiment in EXPERIMENTS}
    return [
        {
            "recording": name,
            "seconds": f"{episode.steps * period:.0f}",
            "purpose": purposes.get(name, ""),
            "ended by": episode.ended_by,
        }
        for name, episode in recordings.items()
    ]


def _quantity_rows(quantities: Sequence[Quantity]) -> list[dict[str, str]]:
    return [
        {
            "quantity": each.words,
            "identified, 95 % interval": f"{interval_text(each.value, each.low, each.high)} {each.unit}",
            "prior": f"{number_text(each.prior)} {each.unit}",
        }
        for each in quantities
    ]


def _friction_rows(candidates: Sequence[Candidate]) -> list[dict[str, str]]:
    return [
        {
            "cart_friction": each.cart_friction,
            "cart RMS error (mm)": f"{1e3 * each.error.x:.2f}",
            "angle RMS error (deg)": f"{math.degrees(each.error.theta):.2f}",
        }
        for each in candidates
    ]
