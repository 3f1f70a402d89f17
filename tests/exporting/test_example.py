"""examples/drive_without_torch.py swings up the pole of an emulated cart, and PyTorch is never imported."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.exporting.agent import ExportedAgent
from cartpole_rl.exporting.weights import write_agent
from cartpole_rl.plants.emulated_cart import EmulatedCart

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples/drive_without_torch.py"
SCRIPT = f"""
import runpy, sys
runpy.run_path({str(EXAMPLE)!r}, run_name="__main__")
assert not {{"torch", "tensordict", "torchrl"}} & {{*sys.modules}}
"""

pytest.importorskip("mujoco", reason='mujoco is missing: pip install "cartpole_rl[emulator]"')


def test_the_example_swings_up_and_balances(exported: ExportedAgent, tmp_path: Path) -> None:
    write_agent(tmp_path / "agent.npz", exported)
    journal = tmp_path / "journal.jsonl"
    with EmulatedCart(EmulatorSettings(physics_step=1e-3, journal=journal)) as cart:
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, tmp_path / "agent.npz", cart.port],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
        )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-2]) > 7.0  # of 10 s
    assert '"took": "STOP"' in journal.read_text().splitlines()[-2] + journal.read_text().splitlines()[-1]
