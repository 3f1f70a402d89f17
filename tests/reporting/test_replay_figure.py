"""The replay's figure shows what it was given, in the units that its axes name."""

import numpy as np
import pytest
from matplotlib import colors

from cartpole_rl.reporting.figures import png
from cartpole_rl.reporting.figures.replays import SIMULATED, replay_figure, root_mean_square
from cartpole_rl.tasks.episode import Episode


def test_rms_is_of_what_is_known() -> None:
    errors = np.array([[3.0, 1.0, np.nan], [4.0, np.nan, np.nan]])
    np.testing.assert_allclose(root_mean_square(errors), [np.sqrt(12.5), 1.0, np.nan])


def test_both_carts_and_the_error_are_drawn(swing_up: Episode) -> None:
    lag = 0.02 * np.arange(51)
    rows = np.arange(0, 450, 50)[:, None] + np.arange(51)
    x, theta = swing_up.x[rows] + 0.02, swing_up.theta[rows]
    theta[-1, 30:] = np.nan
    x_error, theta_error = np.full(rows.shape, 0.02), np.full(rows.shape, np.radians(3))
    figure = replay_figure(
        swing_up, swing_up.time[rows], x, theta, lag, x_error, theta_error, (0.1, 0.5, 1.0, 7.0), "Title"
    )
    assert len(png(figure, dpi=60)) > 10_000
    angle, position, left, right = figure.axes
    simulated = [line for line in position.lines if colors.same_color(line.get_color(), SIMULATED)]
    np.testing.assert_allclose(simulated[0].get_ydata(), 100 * x[0])
    assert position.lines[0].get_ydata() == pytest.approx(100 * swing_up.x)
    assert angle.get_ylabel() == "pole angle (deg)"
    for axes, told in ((left, "20.0 mm"), (right, "3.00 deg")):
        assert [text.get_text() for text in axes.texts].count(told) == 3  # none at 7 s
