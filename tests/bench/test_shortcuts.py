"""The benchmark of the shortcuts runs and writes all rows; how fast they are is not tested."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts/bench/shortcuts.py"


def test_all_rows_are_there(tmp_path: Path) -> None:
    file = tmp_path / "shortcuts.json"
    command = [sys.executable, SCRIPT, "--quick", "--carts", "16", "--json", file]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = {row["name"]: row for row in json.loads(file.read_text())}
    for ours, stock in (
        ("CartPoleEnv, step", "TransformedEnv, step"),
        ("Training.collect", "TorchRL's collector"),
        ("DrivingPolicy", "QValueActor"),
        ("LossGradient", "loss.backward"),
    ):
        assert rows[ours]["to"] == stock
        assert rows[ours]["ratio"] == pytest.approx(rows[stock]["ms"] / rows[ours]["ms"])
        assert ours in done.stdout
