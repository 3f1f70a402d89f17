"""The zero-shot bench: ratios to the nominal score, carts that cannot be driven, and results made before."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import zero_shot
from bench_scripts import Run
from truths import COMPARED, REPORTED

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

WORDS = ("runs/bench/medium/0", "--truths", "1", "--starts", "2", "--json", "zero_shot.json")


def test_ratios_are_relative_to_the_nominal_score(trained: Path, run: Run) -> None:
    shown = run(zero_shot, trained, *WORDS)
    assert "worst start" in shown
    (result,) = json.loads((trained / "zero_shot.json").read_text())
    assert (result["seed"], result["wider"], len(result["carts"])) == (1000, 0, 1)
    for cart in result["carts"]:
        scores = cart["scores"]
        assert len(scores) == 2
        assert cart["mean_ratio"] == pytest.approx(sum(scores) / 2 / result["nominal"])
        assert cart["worst_ratio"] == pytest.approx(min(scores) / result["nominal"])
        assert cart["lost"] == sum(score < 500 for score in scores)
        assert cart["truth"]["cart_coulomb_left"] != cart["truth"]["cart_coulomb_right"]


def test_results_made_before_are_shown_again_and_not_mixed_with_others(tmp_path: Path, run: Run) -> None:
    scores, file = np.array([4000.0, np.nan, 100.0]), tmp_path / "zero_shot.json"
    truth = {"cart_viscous": 0.5, "cart_coulomb_left": 0.4, "cart_coulomb_right": 0.6}
    draw = {"truths": 1, "starts": 2, "seed": 1000, "wider": 0.0}
    cart = zero_shot.cart_figures(truth, scores, 4000.0)
    file.write_text(json.dumps([{"run": WORDS[0], **draw, "nominal": 4000.0, "carts": [cart]}]))
    before = file.read_text()
    assert "not driven" in run(zero_shot, tmp_path, *WORDS)  # without that run folder: it is not driven again
    assert file.read_text() == before
    with pytest.raises(SystemExit) as refused:
        run(zero_shot, tmp_path, *WORDS, "--seed", "0")
    message = "zero_shot.json was made with --seed 1000: use that, or another --json file"
    assert str(refused.value) == message


def test_reports_use_other_carts_than_those_on_which_settings_were_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["zero_shot.py", "runs/train/a"])
    assert zero_shot.parse_options().seed == REPORTED != COMPARED
    monkeypatch.setattr(sys, "argv", ["zero_shot.py", "runs/train/a", "--wider", "1.5"])
    with pytest.raises(SystemExit):
        zero_shot.parse_options()


def test_a_cart_that_cannot_be_driven_is_counted_separately() -> None:
    figures = zero_shot.cart_figures({}, np.array([4000.0, np.nan, 100.0]), 4000.0)
    assert figures["scores"] == [4000.0, None, 100.0]
    assert (figures["mean_ratio"], figures["worst_ratio"]) == pytest.approx((0.5125, 0.025))
    assert (figures["lost"], figures["not_driven"]) == (1, 1)
    assert zero_shot.cart_figures({}, np.array([np.nan]), 4000.0)["mean_ratio"] is None
