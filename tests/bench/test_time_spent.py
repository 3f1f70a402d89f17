"""The time of a training is divided among its parts without a remainder."""

import json
from pathlib import Path

import pytest
import time_spent
from bench_scripts import TINY, Run

from cartpole_rl.agents.settings import AGENTS


def test_the_shares_of_the_parts_add_up(tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    dqn = AGENTS.find("dqn")
    monkeypatch.setattr(dqn, "learner", dqn.learner)  # the script replaces it; this restores it
    run(time_spent, tmp_path, "experiment=medium", "--json", "spent.json", *TINY)
    spent = json.loads((tmp_path / "spent.json").read_text())
    shares = {kind: each["share"] for kind, each in spent.items()}
    assert set(shares) == {"stepping", "updating", "evaluating", "the rest", "compiling"}
    assert sum(shares.values()) == pytest.approx(1)
    assert min(spent[kind]["seconds"] for kind in ("stepping", "evaluating", "the rest")) > 0
