"""The benchmark of the environment runs, and its JSON has every row; how fast they are is not tested."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts/bench/environment.py"


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler: install g++")
def test_all_rows_are_there(tmp_path: Path) -> None:
    file = tmp_path / "environment.json"
    command = [sys.executable, SCRIPT, "--quick", "--threads", "1", "--json", file]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = {row["name"]: row for row in json.loads(file.read_text())}
    for peer, ours in (
        ("Gymnasium CartPole", "dynamics, 1 period a call, 1 substep"),
        ("Gymnasium CartPole", "dynamics, 1 period a call, 4 substeps"),
        ("Gymnasium CartPole", "dynamics, 8 periods a call, 1 substep"),
        ("PendulumEnv, step", "environment, step"),
        ("PendulumEnv, step", "environment, step, not compiled"),
        ("PendulumEnv, rollout", "environment, rollout"),
    ):
        row = rows[ours]
        assert row["peer"] == peer
        assert row["ratio"] == pytest.approx(row["steps_per_second"] / rows[peer]["steps_per_second"])
        assert row["carts"] == rows[peer]["carts"]
        assert ours in done.stdout
