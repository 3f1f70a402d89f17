"""Numbers of reports as text: one form for all, scores without needless digits."""

import pytest

from cartpole_rl.reporting.results import (
    counted_text,
    estimate_text,
    low_is_good,
    sentence_start,
    value_text,
)
from cartpole_rl.reporting.statistics import Estimate


@pytest.mark.parametrize(
    ("found", "measure", "text"),
    [
        (Estimate(4210.3, 4125.1, 4295.5, 10), "score", "4210 (4125 to 4296)"),
        (Estimate(0.012, -0.00002, 0.031, 10), "score", "0.0 (0.0 to 0.0)"),
        (Estimate(0.907, 0.893, 0.93, 10), "", "0.907 (0.893 to 0.930)"),
        (Estimate(0.5, None, None, 1), "", "0.500"),
    ],
)
def test_an_interval_is_written_by_its_ends(found: Estimate, measure: str, text: str) -> None:
    assert estimate_text(found, measure) == text


@pytest.mark.parametrize(("value", "text"), [(4210.4, "4210"), (2.76, "2.8"), (-0.000019, "0.0")])
def test_a_score_has_at_most_one_decimal_and_no_minus_zero(value: float, text: str) -> None:
    assert value_text(value, "score") == text


def test_less_is_better_of_errors_and_times() -> None:
    assert low_is_good("errors.median")
    assert low_is_good("time_to_upright_s")
    assert not low_is_good("score")


def test_counts_and_starts_of_sentences() -> None:
    assert (counted_text(1), counted_text(10, "model")) == ("1 agent", "10 models")
    assert sentence_start("score (6.2)") == "Score (6.2)"
