"""Learning curves show an evaluation as mean and band; comparisons show all episodes."""

import numpy as np
from figure_contents import line_of, words

from cartpole_rl.reporting.scores import SCORES, comparison, learning_curve, score_columns
from cartpole_rl.reporting.style import series_colour


def result(scores: list[float], low: float, high: float) -> dict:
    mean = {"mean": sum(scores) / len(scores), "low": low, "high": high}
    return {"score": mean, "episodes": [{"score": each} for each in scores]}


RESULTS = {
    "simulated": result([4000.0, 4100.0, 4200.0], 4080.0, 4120.0),
    "emulated": result([3000.0, 3200.0], 3050.0, 3150.0),
}


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
    axes = learning_curve(records([100, 900, 4100]), "score").axes[0]
    np.testing.assert_allclose(line_of(axes, series_colour(0)), [[0.1, 100], [0.2, 900], [0.3, 4100]])
    band = axes.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == 0
    assert band[:, 1].max() == 4200
    assert axes.get_xlabel() == "transitions (millions)"
    assert axes.get_ylabel() == "score (6.2) of an episode"


def test_labels_have_interval_and_ratio() -> None:
    text = words(comparison(RESULTS))
    assert "4100 ± 20" in text
    assert "0.76 × simulated" in text
    assert "2 episodes" in text


def test_the_intervals_of_a_row_have_one_form() -> None:
    def summary(low: float) -> dict:
        return {**dict.fromkeys(SCORES), "score": {"mean": 4000.0, "low": low, "high": 4100.0}}

    assert "4000 ± 100" in score_columns({"mean": summary(3900.0)}, "")
    row = score_columns({"here": summary(3900.0), "there": summary(3500.0)}, "").splitlines()[-1]
    assert "4000 (3900 to 4100)  4000 (3500 to 4100)" in row
