"""An agent that cannot swing the pole up does not bring it up again."""

import json
from pathlib import Path

import knocks
from bench_scripts import Run


def test_an_untrained_agent_recovers_from_no_knock(trained: Path, run: Run) -> None:
    run(knocks, trained, "runs/bench/medium/10", "--knocks", "4", "--json", "knocks.json")
    (result,) = json.loads((trained / "knocks.json").read_text())
    assert result["back"] == 0
