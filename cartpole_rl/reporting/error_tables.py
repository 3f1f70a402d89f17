"""Printed tables of prediction errors: of a replay, and of a learned model on held-out recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

from cartpole_rl.reporting.table import number_text, table

REPORTED_TIMES = (0.1, 0.5, 1.0)  # s after a reset
Errors = Sequence[Mapping[str, Any]]  # one mapping for each time after a reset
REPORTED_TIMES = (0.1, 0.5, 1.0)  # s after a reset
ERROR_COLUMNS = {
    "rms_x_mm": "cart RMS (mm)",
    "median_x_mm": "cart median (mm)",
    "rms_theta_deg": "angle RMS (deg)",
    "median_theta_deg": "angle median (deg)",
}


def replay_table(errors: Errors, heading: str) -> str:
    """Return the errors of a replay (`prediction.errors_at`) as a table below `heading`."""
    rows = [{"time": f"{line['after_s']:g}", **_error_cells(line)} for line in errors]
    return f"{heading}\n{table(rows, {'time': 'time (s)', **ERROR_COLUMNS})}"


def model_table(errors: Mapping[str, Errors], heading: str) -> str:
    """Return the errors of several models at the same times as a table below `heading`."""
    first = next(iter(errors))
    rows = [
        {"time": f"{line['after_s']:g}" if model == first else "", "model": model, **_error_cells(line)}
        for lines in zip(*errors.values(), strict=True)
        for model, line in zip(errors, lines, strict=True)
    ]
    return f"{heading}\n{table(rows, {'time': 'time (s)', 'model': 'model', **ERROR_COLUMNS})}"


def spread_table(errors: Errors, spreads: float, heading: str) -> str:
    """Return RMS errors beside RMS ensemble spreads, and the share of errors within `spreads` spreads."""
    columns = {
        "time": "time (s)",
        "x": "cart error / spread (mm)",
        "within_x": f"within {spreads:g} spreads",
        "theta": "angle error / spread (deg)",
        "within_theta": f"within {spreads:g} spreads",
    }
    rows = [
        {
            "time": f"{line['after_s']:g}",
            "x": f"{number_text(line['rms_x_mm'])} / {number_text(line['rms_spread_x_mm'])}",
            "within_x": f"{line['within_x_mm']:.0%}",
            "theta": f"{number_text(line['rms_theta_deg'])} / {number_text(line['rms_spread_theta_deg'])}",
            "within_theta": f"{line['within_theta_deg']:.0%}",
        }
        for line in errors
    ]
    return f"{heading}\n{table(rows, columns)}"


def _error_cells(line: Mapping[str, Any]) -> dict[str, str]:
    return {key: number_text(line[key]) for key in ERROR_COLUMNS}
