"""The benchmark of one cart runs and writes all figures; how fast it is is not tested."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts/bench/one_cart.py"


def test_all_figures_are_there(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="needs the emulator")
    file = tmp_path / "one_cart.json"
    command = [sys.executable, SCRIPT, "--steps", "200", "--episodes", "1", "--json", file]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    figures = json.loads(file.read_text())
    peer, *ours = figures["gymnasium"]
    assert all(row["ratio"] == pytest.approx(row["steps_per_s"] / peer["steps_per_s"]) for row in ours)
    for row in figures["lockstep"]:
        assert row["steps"] == 500
        assert 0 < row["median_ms"] <= row["p999_ms"] <= row["longest_ms"]
        assert row["lockstep"] in done.stdout
