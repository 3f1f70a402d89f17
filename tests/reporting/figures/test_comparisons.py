"""The comparison shows all episodes, their mean and its interval."""

import math

import numpy as np
import pytest
from figure_contents import words

from cartpole_rl.errors import ConfigError
from cartpole_rl.intervals import student_interval
from cartpole_rl.reporting.figures import (
    comparison,
    png,
)

RESULTS = {"simulated": [4000.0, 4100.0, 4200.0], "emulated": [3000.0, 3200.0]}


def test_dots_are_the_episodes_and_lines_their_means() -> None:
    axes = comparison(RESULTS).axes[0]
    dots, mean = axes.lines[0], axes.lines[1]
    assert sorted(dots.get_ydata()) == RESULTS["simulated"]
    np.testing.assert_allclose(mean.get_ydata(), 4100)
    assert axes.get_ylabel() == "score of an episode"


def test_labels_have_interval_and_ratio() -> None:
    text = words(comparison(RESULTS, intervals={"simulated": (4080.0, 4120.0)}))
    assert "4100 ± 20" in text
    assert "0.76 × simulated" in text
    assert "2 episodes" in text


def test_student_interval_holds_the_mean_95_times_in_100() -> None:
    generator = np.random.default_rng(0)
    intervals = [student_interval(generator.normal(5, 2, 8)) for _ in range(2000)]
    assert np.mean([low < 5 < high for low, high in intervals]) == pytest.approx(0.95, abs=0.015)


def test_a_single_episode_has_no_interval() -> None:
    assert png(comparison({"serial": [4000.0]}))
    assert all(math.isnan(end) for end in student_interval(np.array([1.0])))


@pytest.mark.parametrize("results", [{}, {"serial": []}])
def test_nothing_to_draw_is_an_error(results: dict) -> None:
    with pytest.raises(ConfigError, match="at least one"):
        comparison(results)
