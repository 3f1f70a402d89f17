"""Learning curves show every run and the median of those with one label; comparisons show all episodes."""

import numpy as np
import pytest
from figure_contents import line_of, words

from cartpole_rl.intervals import student_interval
from cartpole_rl.reporting.scores import comparison, learning_curve
from cartpole_rl.reporting.style import series_colour

RESULTS = {"simulated": [4000.0, 4100.0, 4200.0], "emulated": [3000.0, 3200.0]}


def records(scores: list[float], transitions_apart: int = 100_000) -> list[dict]:
    """Evaluations a second apart whose episodes lie 100 around the mean."""
    return [
        {
            "transitions": (i + 1) * transitions_apart,
            "seconds": float(i + 1),
            "score": score,
            "score_min": score - 100,
            "score_max": score + 100,
        }
        for i, score in enumerate(scores)
    ]


def test_one_run_is_a_line_over_millions_of_transitions_in_its_band() -> None:
    axes = learning_curve([("medium", records([100, 900, 4100]))]).axes[0]
    np.testing.assert_allclose(line_of(axes, series_colour(0)), [[0.1, 100], [0.2, 900], [0.3, 4100]])
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == 0
    assert band[:, 1].max() == 4200
    assert axes.get_xlabel() == "transitions (millions)"
    assert axes.get_ylabel() == "score (6.2) of an episode"


def test_runs_of_one_label_get_their_median() -> None:
    runs = [("medium", records([score, 2 * score])) for score in (100.0, 300.0, 2000.0)]
    axes = learning_curve(runs).axes[0]
    assert len(axes.lines) == 4
    thick = max(axes.lines, key=lambda line: line.get_linewidth())
    np.testing.assert_allclose(thick.get_ydata(), [300, 600])
    assert "median of 3 runs" in axes.get_legend().get_texts()[0].get_text()


def test_runs_with_different_evaluation_points_are_interpolated() -> None:
    runs = [("a", records([0, 300], 300_000)), ("a", records([0, 100, 200, 300, 400, 500, 600]))]
    axes = learning_curve(runs).axes[0]
    thick = max(axes.lines, key=lambda line: line.get_linewidth())
    transitions, scores = thick.get_xydata().T
    assert transitions[0] == pytest.approx(0.3)
    assert transitions[-1] == pytest.approx(0.6)
    assert scores[0] == pytest.approx((0 + 200) / 2)
    assert scores[-1] == pytest.approx((300 + 500) / 2)


def test_labels_have_interval_and_ratio() -> None:
    text = words(comparison(RESULTS, intervals={"simulated": (4080.0, 4120.0)}))
    assert "4100 ± 20" in text
    assert "0.76 × simulated" in text
    assert "2 episodes" in text


def test_student_interval_holds_the_mean_95_times_in_100() -> None:
    generator = np.random.default_rng(0)
    intervals = [student_interval(generator.normal(5, 2, 8)) for _ in range(2000)]
    assert np.mean([low < 5 < high for low, high in intervals]) == pytest.approx(0.95, abs=0.015)
