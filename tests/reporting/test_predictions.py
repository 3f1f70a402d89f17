"""Figures and tables of prediction errors show what they were given, in the units that they name."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from figure_contents import line_of
from matplotlib.figure import Figure

from cartpole_rl.drawing import colours
from cartpole_rl.identification.prediction import Prediction
from cartpole_rl.physics.residual import PLACES, Residual
from cartpole_rl.reporting.predictions import (
    _mark_times,
    ensemble_figure,
    error_table,
    forces_along_track,
)

ERRORS = {"rms_x_mm": 1.234, "median_x_mm": 1.0, "rms_theta_deg": 0.5, "median_theta_deg": 0.25}


def test_a_replay_has_a_row_for_each_time() -> None:
    heading, columns, _, *rows = error_table(
        {"": [{"after_s": time, **ERRORS} for time in (0.1, 1.0)]}, "errors"
    ).splitlines()
    assert heading == "errors"
    assert columns.split("  ")[0] == "time (s)"
    assert "cart RMS (mm)" in columns
    assert [row.split() for row in rows] == [
        ["0.1", "1.23", "1.00", "0.500", "0.250"],
        ["1", "1.23", "1.00", "0.500", "0.250"],
    ]


def test_a_time_between_two_periods_is_marked_at_the_nearest() -> None:
    axes, lag = Figure().subplots(), 0.03 * np.arange(20)
    _mark_times(axes, lag, np.ones((20, 1)), (0.1, 0.5, 1.0), "mm")
    assert [text.xy[0] for text in axes.texts] == pytest.approx([0.09, 0.51])


def test_forces_are_known_where_the_cart_was() -> None:
    outputs = torch.arange(2.0 * PLACES).reshape(2, PLACES)
    residual = with_tables(outputs)
    spacing = float(residual.spacing)
    places, forces = forces_along_track(residual, np.array([0.0, 3 * spacing, 3.1 * spacing]))
    visited = np.isfinite(forces[0])
    np.testing.assert_allclose(places[visited], [0.0, 3 * spacing], atol=1e-9)
    np.testing.assert_allclose(forces[:, visited], (residual.units[0] * outputs).numpy()[:, visited])


def with_tables(outputs: torch.Tensor) -> Residual:
    """A residual with tables of `outputs` [M, PLACES]."""
    return Residual.untrained(len(outputs), 2, torch.Generator(), 0.02, 4.0, 0.814)._replace(places=outputs)


def test_errors_are_in_the_units_of_the_axes() -> None:
    physics, learned = (
        Prediction(*(np.full((51, 2, 7), each) for each in (0.1, error, 0.005))) for error in (0.02, 0.01)
    )
    ensemble = SimpleNamespace(
        dynamics=SimpleNamespace(period=0.02),
        best=with_tables(torch.ones(3, PLACES)),
        positions=torch.linspace(-0.1, 0.1, 500).reshape(-1, 1, 1).expand(-1, 2, 1),
        updates=[0, 20],
        history=[[1.0] * 3] * 2,
    )
    figure = ensemble_figure(physics, learned, ensemble, "")
    cart, angle, track, learning = figure.axes
    assert line_of(cart, colours.VERMILLION)[:, 1] == pytest.approx(20)
    assert line_of(angle, colours.BLUE)[:, 1] == pytest.approx(np.degrees(0.01))
    assert track.get_xlim() == pytest.approx((-10, 10), abs=0.5)
    assert learning.get_ylabel() == "validation loss"
