"""The figures of an identification show values, intervals and priors where they are."""

import numpy as np
import pytest
from figure_contents import line_of, words

from cartpole_rl.identification.prediction import Replayed
from cartpole_rl.identification.quantities import Quantity
from cartpole_rl.reporting.curves import Curve
from cartpole_rl.reporting.figures import png
from cartpole_rl.reporting.figures.identified import (
    FARTHEST,
    IDENTIFIED,
    PRIOR,
    SIMULATED,
    experiments_figure,
    friction_and_force_figure,
    interval_figure,
    spectrum_figure,
)


def test_curves_are_drawn_with_their_band() -> None:
    at = np.linspace(-1, 1, 5)
    curve = Curve(at, 2 * at, 2 * at[:, None] + np.linspace(-1, 1, 201), 3 * at)
    left, right = friction_and_force_figure(curve, curve).axes
    np.testing.assert_allclose(line_of(left, IDENTIFIED)[:, 1], 2 * at)
    np.testing.assert_allclose(line_of(left, PRIOR)[:, 1], 3 * at)
    heights = left.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((-2.95, 2.95))
    assert left.get_xlabel() == "cart velocity (m/s)"
    assert right.get_ylabel() == "force on the cart (N)"


def test_priors_stand_in_half_widths_and_far_ones_become_arrows() -> None:
    figure = interval_figure(
        [
            Quantity("near", "a near prior", "ms", 12.0, 11.0, 13.0, 15.0),
            Quantity("far", "a far prior", "N", 1.0, 0.9, 1.1, 9.0),
        ]
    )
    (axes,) = figure.axes
    priors = {
        line.get_ydata()[0]: (line.get_xdata()[0], line.get_marker())
        for line in axes.lines
        if line.get_color() == PRIOR
    }
    assert priors[1] == (pytest.approx(3.0), "D")
    assert priors[0] == (FARTHEST, ">")
    assert "12.0 ± 1.0 ms   (prior 15.0)" in words(figure)


def test_experiments_are_drawn_with_their_simulation(replay: Replayed) -> None:
    figure = experiments_figure({"swing": replay, "coast": replay})
    position, angle = figure.axes[:2]
    simulated = [line for line in position.lines if line.get_color() == SIMULATED]
    assert len(simulated) == len(replay.x)
    np.testing.assert_allclose(simulated[0].get_ydata(), 100 * replay.x[0])
    assert len(simulated[-1].get_ydata()) == 30  # the rest is not known
    assert position.get_title(loc="left") == "swing"
    assert angle.get_ylabel() == "from hanging (deg)"
    assert png(figure, dpi=40)


def test_the_spectrum_is_that_of_the_covariance() -> None:
    figure = spectrum_figure(np.diag([0.25, 0.01]), ["latency", "cart_mass"])
    bars, weights = figure.axes
    assert [bar.get_width() for bar in bars.patches] == pytest.approx([0.1, 0.5])
    np.testing.assert_allclose(weights.images[0].get_array(), [[0, 1], [1, 0]])
    assert [label.get_text() for label in weights.get_xticklabels()] == ["latency", "cart_mass"]
