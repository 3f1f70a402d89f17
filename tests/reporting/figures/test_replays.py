"""The replay's figure shows what it was given, in the units that its axes name."""

import numpy as np
import pytest
from matplotlib import colors

from cartpole_rl.identification.prediction import Replayed
from cartpole_rl.reporting.figures import png
from cartpole_rl.reporting.figures.replays import SIMULATED, replay_figure


def test_both_carts_and_the_error_are_drawn(replay: Replayed) -> None:
    figure = replay_figure([replay], 0.02, (0.1, 0.5, 1.0, 7.0), "Title")
    assert len(png(figure, dpi=60)) > 10_000
    angle, position, left, right = figure.axes
    simulated = [line for line in position.lines if colors.same_color(line.get_color(), SIMULATED)]
    np.testing.assert_allclose(simulated[0].get_ydata(), 100 * replay.x[0])
    assert position.lines[0].get_ydata() == pytest.approx(100 * replay.episode.x)
    assert angle.get_ylabel() == "pole angle (deg)"
    for axes, text in ((left, "20.0 mm"), (right, "3.00 deg")):
        assert [each.get_text() for each in axes.texts].count(text) == 3  # none at 7 s
    assert left.get_xlabel() == "time since the reset (s)"
