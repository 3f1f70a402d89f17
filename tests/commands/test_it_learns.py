"""Learning itself: a short training that ends far above what no learning gets. Fails when learning breaks."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SHORT = [
    "compile=false",
    "learning.frames=327680",
    "learning.epsilon_frames=100000",
    "learning.evaluations=2",
]


def train(folder: Path, *overrides: str) -> dict:
    """metrics.json of a training with `overrides`."""
    command = [Path(sys.executable).with_name("cartpole-train"), *overrides, f"hydra.run.dir={folder}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.timeout(300)
def test_the_balance_is_learned(tmp_path: Path) -> None:
    metrics = train(tmp_path, "experiment=balance", *SHORT)
    assert metrics["score_upright"]["mean"] > 450  # of 500; an untrained agent falls within 30 steps
    assert {episode["ended_by"] for episode in metrics["episodes"]} == {"time"}


@pytest.mark.timeout(300)
def test_the_swing_up_is_under_way(tmp_path: Path) -> None:
    metrics = train(tmp_path, "experiment=medium", *SHORT)
    assert metrics["score"]["mean"] > 100  # an untrained agent gets under 20: the pole hangs
