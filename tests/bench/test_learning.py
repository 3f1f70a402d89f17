"""Learning is judged by the last checkpoint, relative to the reference, and a training is not repeated."""

import json
from pathlib import Path

import learning
import pytest
from bench_scripts import Run
from common import REFERENCES


def test_each_seed_is_judged_by_its_last_checkpoint(trained: Path) -> None:
    seed = json.loads((trained / "learning.json").read_text())["medium"]["10"]
    reference = json.loads(REFERENCES.read_text())["medium"]["score"]
    figures = seed["plants"]["medium"]
    assert figures["fraction"] == pytest.approx(figures["score"] / reference)
    assert figures["worst_start"] <= figures["score"] < 1500  # hardly trained
    assert seed["seconds_to_reached"] is None
    assert seed["seconds"] > 0


def test_a_trained_seed_is_not_trained_again(
    trained: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "DRAWN_CARTS", 10)
    checkpoint = trained / "runs/bench/medium/10/checkpoints/last.pt"
    before = checkpoint.stat().st_mtime_ns
    assert "fraction, medium" in run(learning, trained, "medium", "--seeds", "1")
    assert checkpoint.stat().st_mtime_ns == before
