"""Stable-Baselines3 trains on the registered environments unchanged."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "examples/stable_baselines3_dqn.py"

pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")


@pytest.mark.parametrize("name", ["cartpole_rl/Balance-v0", "cartpole_rl/SwingUp-v0"])
def test_the_example_trains_and_judges(name: str, tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--env", name, "--steps", "600", "--episodes", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    score = re.search(r"^score (-?\d+) \+- 0 over 1 episodes$", done.stdout, re.MULTILINE)
    assert score is not None
    least = (
        0 if "SwingUp" in name else 1
    )  # in 600 steps no agent learns to leave the hanging pole's score of 0
    assert least <= int(score[1]) <= 10_000
