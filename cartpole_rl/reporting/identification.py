"""Page and tables of an identification."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cartpole_rl.reporting.page import page
from cartpole_rl.reporting.table import interval_text, number_text, table
from cartpole_rl.run_files import FIGURES

CAPTIONS = {  # figures/<name>.png: caption
    "friction_and_force": "Friction of the cart and force of the motor, with 95 % bands",
    "intervals": "Identified values with 95 % intervals, and prior values",
    "experiments": "The experiments, measured and simulated; the simulated cart is reset to the measured "
    "state every second",
    "held_out": "The held-out experiment, which was not used in the fit",
    "spectrum": "Remaining uncertainty of each combination of parameters, relative to the prior",
}


class Estimate(NamedTuple):
    """An identified quantity with its 95 % interval and its prior value."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    prior: float

    @property
    def text(self) -> str:
        """Value, interval and unit."""
        return f"{interval_text(self.value, self.low, self.high)} {self.unit}"


class PredictionError(NamedTuple):
    """RMS error of a prediction over one second of held-out motion, away from upright."""

    x: float  # m
    theta: float  # rad

    @property
    def text(self) -> str:
        """The errors with their units."""
        return f"{1e3 * self.x:.2f} mm and {math.degrees(self.theta):.2f} deg"


class Recording(NamedTuple):
    """A recording that a cart was fitted to."""

    name: str
    seconds: float
    purpose: str
    ended_by: str


def estimates_table(estimates: Sequence[Estimate]) -> str:
    """Return the identified values as a table for the terminal."""
    rows = [
        {"name": each.name, "value": interval_text(each.value, each.low, each.high), "unit": each.unit}
        for each in estimates
    ]
    return table(rows, {"name": "quantity", "value": "value, 95 % interval", "unit": "unit"})


def identification_page(
    recordings: Sequence[Recording],
    estimates: Sequence[Estimate],
    friction_models: Mapping[str, PredictionError],
    held_out: PredictionError,
    warnings: Sequence[str],
    next_command: str,
) -> str:
    """Return the HTML page of an identification, which shows the figures of CAPTIONS in figures/."""
    sections: list[tuple[str, Any]] = [
        ("Recordings", _recording_rows(recordings)),
        ("Identified values", _estimate_rows(estimates)),
        ("Friction models of the cart", _friction_rows(friction_models)),
        (
            "",
            "RMS prediction error over one second of held-out motion away from upright, with the best model: "
            f"{held_out.text}.",
        ),
        ("Warnings", [*warnings] or ["None."]),
        ("Next step: train on carts like this one", [f"<code>{next_command}</code>"]),
        *[(caption, Path(FIGURES) / f"{name}.png") for name, caption in CAPTIONS.items()],
    ]
    return page("Identification of a cart", sections)


def _recording_rows(recordings: Sequence[Recording]) -> list[dict[str, str]]:
    return [
        {
            "recording": each.name,
            "seconds": f"{each.seconds:.0f}",
            "purpose": each.purpose,
            "ended by": each.ended_by,
        }
        for each in recordings
    ]


def _estimate_rows(estimates: Sequence[Estimate]) -> list[dict[str, str]]:
    return [
        {
            "quantity": each.name,
            "identified, 95 % interval": each.text,
            "prior": f"{number_text(each.prior)} {each.unit}",
        }
        for each in estimates
    ]


def _friction_rows(friction_models: Mapping[str, PredictionError]) -> list[dict[str, str]]:
    return [
        {
            "cart_friction": name,
            "cart RMS error (mm)": f"{1e3 * error.x:.2f}",
            "angle RMS error (deg)": f"{math.degrees(error.theta):.2f}",
        }
        for name, error in friction_models.items()
    ]
