"""The scripts that judge agents run from an untrained seed to their tables."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[2] / "scripts" / "bench"
TINY = ["learning.transitions=2048", "learning.carts=16", "learning.evaluations=2", "compile=false"]


def bench(folder: Path, script: str, *arguments: str) -> str:
    """Run a script in `folder`; its output."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, BENCH / script, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which one seed of the medium pole was trained a little and judged."""
    folder = tmp_path_factory.mktemp("bench")
    table = bench(folder, "learning.py", "medium", "--seeds", "1", "--json", "learning.json", *TINY)
    assert "fraction, medium" in table
    return folder


def test_each_seed_is_judged_by_its_last_checkpoint(trained: Path) -> None:
    seed = json.loads((trained / "learning.json").read_text())["medium"]["0"]
    reference = json.loads((BENCH / "references.json").read_text())["medium"]["score"]
    figures = seed["plants"]["medium"]
    assert figures["fraction"] == pytest.approx(figures["score"] / reference)
    assert figures["worst_start"] <= figures["score"] < 1500  # hardly trained at all
    assert seed["seconds_to_reached"] is None
    assert seed["seconds"] > 0


def test_a_trained_seed_is_not_trained_again(trained: Path) -> None:
    checkpoint = trained / "runs/bench/medium/0/checkpoints/last.pt"
    before = checkpoint.stat().st_mtime_ns
    bench(trained, "learning.py", "medium", "--seeds", "1")
    assert checkpoint.stat().st_mtime_ns == before


def test_zero_shot_divides_by_the_nominal_score(trained: Path) -> None:
    words = ("zero_shot.py", "runs/bench/medium/0", "--truths", "2", "--starts", "2", "--jobs", "2")
    shown = bench(trained, *words, "--json", "zero_shot.json")
    assert "worst start" in shown
    (result,) = json.loads((trained / "zero_shot.json").read_text())
    assert (result["seed"], result["wider"], len(result["carts"])) == (1000, 0, 2)
    for cart in result["carts"]:
        scores = cart["scores"]
        assert len(scores) == 2
        assert cart["mean_ratio"] == pytest.approx(sum(scores) / 2 / result["nominal"])
        assert cart["worst_ratio"] == pytest.approx(min(scores) / result["nominal"])
        assert cart["lost"] == sum(score < 500 for score in scores)
        assert cart["truth"]["cart_coulomb_left"] != cart["truth"]["cart_coulomb_right"]

    before = (trained / "zero_shot.json").read_text()
    assert "not driven" in bench(trained, *words, "--json", "zero_shot.json")  # at once: it is known
    assert (trained / "zero_shot.json").read_text() == before
    other = [sys.executable, BENCH / "zero_shot.py", *words[1:], "--seed", "0", "--json", "zero_shot.json"]
    done = subprocess.run(other, cwd=trained, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == "zero_shot.json is of --seed 1000: give the same, or another --json\n"


def test_an_untrained_agent_comes_back_from_no_knock(trained: Path) -> None:
    bench(trained, "knocks.py", "runs/bench/medium/0", "--knocks", "4", "--json", "knocks.json")
    (result,) = json.loads((trained / "knocks.json").read_text())
    assert result["back"] == 0


def test_the_time_of_a_training_is_told_apart(tmp_path: Path) -> None:
    bench(tmp_path, "time_spent.py", "experiment=medium", "--json", "spent.json", *TINY)
    spent = json.loads((tmp_path / "spent.json").read_text())
    shares = {kind: each["share"] for kind, each in spent.items()}
    assert set(shares) == {"stepping", "updating", "evaluating", "the rest", "compiling"}
    assert sum(shares.values()) == pytest.approx(1)
    assert min(spent[kind]["seconds"] for kind in ("stepping", "evaluating", "the rest")) > 0
