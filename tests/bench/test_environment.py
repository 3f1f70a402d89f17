"""The benchmark of the environment runs, and its JSON has every row; how fast they are is not tested."""

import json
from pathlib import Path

import environment
import pytest
import torch
from bench_scripts import Run


def test_all_rows_are_there(tmp_path: Path, run: Run) -> None:
    threads = torch.get_num_threads()
    shown = run(environment, tmp_path, "--quick", "--threads", str(threads), "--json", "environment.json")
    rows = {row["name"]: row for row in json.loads((tmp_path / "environment.json").read_text())}
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
        assert ours in shown
