"""The zero-shot bench: fractions of each cart's own reference, carts not driven, and results made before."""

import json
import sys
from pathlib import Path

import pytest
import truth_references
import zero_shot
from bench_scripts import Run
from truth_references import Draw, add_reference, digest, known_references
from truths import COMPARED, REPORTED

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

WORDS = ("runs/bench/medium/10", "--truths", "1", "--starts", "2", "--json", "zero_shot.json")
DRAW = Draw(REPORTED, 0.0)


@pytest.fixture
def references(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of references."""
    monkeypatch.setattr(truth_references, "FOLDER", tmp_path / "references")
    return tmp_path / "references"


def test_fractions_are_relative_to_the_reference_of_the_cart(
    trained: Path, run: Run, references: Path
) -> None:
    (truth,) = DRAW.truths(1)
    add_reference(DRAW, 0, truth, {"score": 100.0})
    shown = run(zero_shot, trained, *WORDS)
    assert "mean fraction" in shown
    result = json.loads((trained / "zero_shot.json").read_text())
    assert (result["seed"], result["wider"], result["starts"]) == (2026, 0, 2)
    (agent,) = result["agents"]
    (cart,) = agent["carts"]
    assert len(cart["scores"]) == 2
    assert cart["fraction"] == pytest.approx(sum(cart["scores"]) / 2 / 100)
    assert agent["mean_fraction"] == agent["worst_fraction"] == cart["fraction"]
    assert cart["lost"] == sum(score < 500 for score in cart["scores"])
    assert cart["beaten"] == (max(cart["scores"]) > 100) == ("too low" in shown)
    before = (trained / "zero_shot.json").read_text()
    (references / "2026_0.json").unlink()
    shown = run(zero_shot, trained, *WORDS)  # nothing is driven again, only the reference is gone
    assert (
        "1 of 1 truths have no reference score: run scripts/bench/reference.py --truths 1 --seed 2026"
        in shown
    )
    (agent,) = json.loads((trained / "zero_shot.json").read_text())["agents"]
    assert agent["carts"][0]["scores"] == cart["scores"]
    assert agent["mean_fraction"] is None
    assert before != (trained / "zero_shot.json").read_text()


def test_results_of_other_carts_are_not_mixed(tmp_path: Path, run: Run) -> None:
    file = tmp_path / "zero_shot.json"
    file.write_text(json.dumps({"seed": 2026, "wider": 0.0, "starts": 2, "agents": []}))
    with pytest.raises(SystemExit) as refused:
        run(zero_shot, tmp_path, *WORDS, "--seed", "0")
    assert str(refused.value) == "zero_shot.json was made with --seed 2026: use that, or another --json file"


def test_reports_use_other_carts_than_those_on_which_settings_are_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["zero_shot.py", "runs/train/a"])
    assert zero_shot.parse_options().seed == REPORTED != COMPARED
    monkeypatch.setattr(sys, "argv", ["zero_shot.py", "runs/train/a", "--wider", "1.5"])
    with pytest.raises(SystemExit):
        zero_shot.parse_options()


def test_a_cart_that_cannot_be_driven_is_counted_separately() -> None:
    figures = zero_shot.cart_figures(0, {}, 4000.0, [4100.0, None, 100.0])
    assert (figures["score"], figures["fraction"]) == pytest.approx((2100, 0.525))
    assert (figures["lost"], figures["not_driven"], figures["beaten"]) == (1, 1, True)
    assert zero_shot.cart_figures(0, {}, 4000.0, [None])["fraction"] is None
    agent = zero_shot.agent_figures("a", [figures, zero_shot.cart_figures(1, {}, 4000.0, [3600.0, 3600.0])])
    assert agent["mean_fraction"] == pytest.approx((0.525 + 0.9) / 2)
    assert agent["worst_fraction"] == pytest.approx(0.525)
    assert (agent["lost_share"], agent["not_driven"], agent["beaten"]) == (0.25, 1, 1)


def test_a_reference_of_other_numbers_is_not_used(references: Path) -> None:
    truths = DRAW.truths(3)
    add_reference(DRAW, 2, truths[2], {"score": 4500.0})
    assert known_references(DRAW, truths) == [None, None, 4500.0]
    assert known_references(DRAW, truths[:2]) == [None, None]
    heavier = {**truths[2], "cart_mass": 1.01 * truths[2]["cart_mass"]}
    assert digest(heavier) != digest(truths[2])
    assert known_references(DRAW, [*truths[:2], heavier]) == [None, None, None]
    assert known_references(Draw(REPORTED, 0.5), truths) == [None, None, None]
