"""The histograms of a randomization count all draws."""

import math

import numpy as np
import pytest
from figure_contents import words

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.figures import (
    randomization_histograms,
)


def test_each_parameter_has_a_panel_that_counts_all_draws() -> None:
    generator = np.random.default_rng(1)
    draws = {f"p{i} (kg)": generator.uniform(i, i + 1, 300) for i in range(5)}
    figure = randomization_histograms(draws, nominal={"p2 (kg)": 2.5})
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in panels] == list(draws)
    for axes, values in zip(panels, draws.values(), strict=True):
        assert sum(bar.get_height() for bar in axes.patches) == 300
        assert axes.patches[0].get_x() == pytest.approx(values.min())
    assert panels[2].lines[0].get_xdata()[0] == 2.5


def test_a_parameter_that_never_varies_is_said_to_be_fixed() -> None:
    assert "fixed at 9.81" in words(randomization_histograms({"gravity": np.full(10, 9.81)}))


@pytest.mark.parametrize("draws", [{}, {"mass": [math.nan]}])
def test_nothing_to_draw_is_an_error(draws: dict) -> None:
    with pytest.raises(ConfigError):
        randomization_histograms(draws)
