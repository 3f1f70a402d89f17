"""Tables line up; their numbers, and those of reports, are rounded to what a reader can use."""

import math

import pytest

from cartpole_rl.reporting.results import estimate_text, value_text
from cartpole_rl.reporting.statistics import Estimate
from cartpole_rl.reporting.texts import SCORES, interval_text, number_text, score_columns, table


def test_layout_of_a_table() -> None:
    rows = [
        {"plant": "simulated", "score": "4210 ± 85", "ratio": None, "episodes": 20, "rms": 0.01234},
        {"plant": "emulated", "score": "912 ± 5", "ratio": 0.2166, "episodes": 5, "rms": 0.3},
    ]
    columns = {"plant": "plant", "score": "score", "ratio": "ratio", "episodes": "n", "rms": "rms (rad)"}
    assert table(rows, columns).splitlines() == [
        "plant          score  ratio   n  rms (rad)",
        "─────────  ─────────  ─────  ──  ─────────",
        "simulated  4210 ± 85      –  20      0.012",
        "emulated     912 ± 5  0.217   5      0.300",
    ]


def test_nan_is_a_dash_and_does_not_affect_its_column() -> None:
    assert table([{"a": math.nan}, {"a": 4210.37}], ["a"]).splitlines()[2:] == ["   –", "4210"]


@pytest.mark.parametrize(
    ("mean", "low", "high", "text"),
    [
        (4210.3, 4125.1, 4295.5, "4210 ± 85"),
        (0.9432, 0.9309, 0.9555, "0.943 ± 0.012"),
        (12.0, 10.6, 13.4, "12.0 ± 1.4"),
        (3517.0, 2200.0, 4834.0, "3517 ± 1317"),
        (4350.0, 4110.0, 4420.0, "4350 (4110 to 4420)"),
        (4210.3, math.nan, math.nan, "4210"),
        (500.0, 500.0, 500.0, "500 ± 0"),
        (0.0, 0.0, 0.0, "0 ± 0"),
    ],
)
def test_interval_text(mean: float, low: float, high: float, text: str) -> None:
    assert interval_text(mean, low, high) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(4210.4, "4210"), (12.345, "12.3"), (0.004561, "0.00456"), (0.0, "0"), (-7.0, "-7.00"), (math.nan, "–")],
)
def test_number_text(value: float, text: str) -> None:
    assert number_text(value) == text


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


def test_the_intervals_of_a_row_have_one_form() -> None:
    def summary(low: float) -> dict:
        return {**dict.fromkeys(SCORES), "score": {"mean": 4000.0, "low": low, "high": 4100.0}}

    assert "4000 ± 100" in score_columns({"mean": summary(3900.0)}, "")
    row = score_columns({"here": summary(3900.0), "there": summary(3500.0)}, "").splitlines()[-1]
    assert "4000 (3900 to 4100)  4000 (3500 to 4100)" in row
