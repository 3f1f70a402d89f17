"""The figures of the fine-tuning bench."""

import fine_tuning
import pytest


def found(before: list[float], after: list[float]) -> dict[str, object]:
    scores = {"before": before, "tune": [300.0, 4000.0], "after": after}
    return {"scores": scores, "left_track": 1, "left_track_first": True, "seconds": 60.0}


def test_figures_compare_with_the_reference_of_the_cart() -> None:
    better = fine_tuning.cart_figures("a", 0, {}, 5000.0, found([4000, 4200], [4400, 4600]))
    worse = fine_tuning.cart_figures("a", 1, {}, 4000.0, found([3600, 3600], [400, 3000]))
    assert better["fraction"] == pytest.approx({"before": 0.82, "after": 0.9})
    assert worse["lost"] == {"before": 0, "tune": 1, "after": 1}
    failed = fine_tuning.cart_figures("a", 2, {}, 4000.0, {"error": "homing failed"})
    row = fine_tuning.agent_row("a", [better, worse, failed])
    assert (row["carts"], row["not tuned"], row["ended below"]) == (2, 1, 1)
    assert (row["mean before"], row["worst after"]) == ("3850", "1700")
    assert row["mean fraction after"] == pytest.approx((0.9 + 0.425) / 2)
    assert (row["left track"], row["in first episode"]) == (2, 2)
    assert row["lost before, tuning, after"] == "0, 2, 1"


def test_without_a_reference_there_are_scores_and_no_fractions() -> None:
    figures = fine_tuning.cart_figures("a", 0, {}, None, found([4000], [4100]))
    assert figures["fraction"] == {"before": None, "after": None}
    assert fine_tuning.agent_row("a", [figures])["mean fraction after"] is None
