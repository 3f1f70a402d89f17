"""Figures and tables of prediction errors show what they were given, in the units that they name."""

import numpy as np
import pytest
from figure_contents import line_of
from matplotlib import colors

from cartpole_rl.drawing import colours
from cartpole_rl.identification.prediction import Prediction, Replayed
from cartpole_rl.physics.residual import PLACES, SPACING, UNITS
from cartpole_rl.reporting.predictions import (
    SIMULATED,
    forces_along_track,
    learned_model_figure,
    model_table,
    replay_figure,
    replay_table,
    spread_table,
)

ERRORS = {"rms_x_mm": 1.234, "median_x_mm": 1.0, "rms_theta_deg": 0.5, "median_theta_deg": 0.25}
SPREADS = {"rms_spread_x_mm": 2.0, "rms_spread_theta_deg": 1.0, "within_x_mm": 0.9, "within_theta_deg": 1.0}


def test_a_replay_has_a_row_for_each_time() -> None:
    heading, columns, _, *rows = replay_table(
        [{"after_s": time, **ERRORS} for time in (0.1, 1.0)], "errors"
    ).splitlines()
    assert heading == "errors"
    assert columns.split("  ")[0] == "time (s)"
    assert "cart RMS (mm)" in columns
    assert [row.split() for row in rows] == [
        ["0.1", "1.23", "1.00", "0.500", "0.250"],
        ["1", "1.23", "1.00", "0.500", "0.250"],
    ]


def test_models_are_compared_at_each_time() -> None:
    lines = [{"after_s": 0.1, **ERRORS}]
    rows = model_table({"physics": lines, "learned": lines}, "errors").splitlines()[3:]
    assert [row.split()[:2] for row in rows] == [["0.1", "physics"], ["learned", "1.23"]]


def test_errors_are_listed_with_spreads() -> None:
    text = spread_table([{"after_s": 0.5, **ERRORS, **SPREADS}], 2.0, "spreads")
    assert "within 2 spreads" in text
    assert text.splitlines()[-1].split() == ["0.5", "1.23", "/", "2.00", "90%", "0.500", "/", "1.00", "100%"]


def test_both_carts_and_the_error_are_drawn(replay: Replayed) -> None:
    figure = replay_figure([replay], 0.02, (0.1, 0.5, 1.0, 7.0), "Title")
    angle, position, left, right = figure.axes
    simulated = [line for line in position.lines if colors.same_color(line.get_color(), SIMULATED)]
    np.testing.assert_allclose(simulated[0].get_ydata(), 100 * replay.x[0])
    assert position.lines[0].get_ydata() == pytest.approx(100 * replay.episode.x)
    assert angle.get_ylabel() == "pole angle (deg)"
    for axes, text in ((left, "20.0 mm"), (right, "3.00 deg")):
        assert [each.get_text() for each in axes.texts].count(text) == 3  # none at 7 s
    assert left.get_xlabel() == "time since the reset (s)"


def test_forces_are_known_where_the_cart_was() -> None:
    outputs = np.arange(2.0 * PLACES).reshape(2, PLACES)
    places, forces = forces_along_track(outputs, np.array([0.0, 3 * SPACING, 3.1 * SPACING]))
    visited = np.isfinite(forces[0])
    np.testing.assert_allclose(places[visited], [0.0, 3 * SPACING], atol=1e-12)
    np.testing.assert_allclose(forces[:, visited], UNITS[0] * outputs[:, visited])


def test_errors_are_in_the_units_of_the_axes() -> None:
    physics, learned = (
        Prediction(*(np.full((51, 2, 7), each) for each in (0.1, error, 0.005))) for error in (0.02, 0.01)
    )
    places, forces = forces_along_track(np.ones((3, PLACES)), np.linspace(-0.1, 0.1, 500))
    updates, losses = np.array([0.0, 20.0]), np.ones((2, 3))
    figure = learned_model_figure(0.02, physics, learned, places, forces, updates, losses)
    cart, angle, track, learning = figure.axes
    assert line_of(cart, colours.VERMILLION)[:, 1] == pytest.approx(20)
    assert line_of(angle, colours.BLUE)[:, 1] == pytest.approx(np.degrees(0.01))
    assert track.get_xlim() == pytest.approx((-10, 10), abs=0.5)
    assert learning.get_ylabel() == "validation loss"
