"""The time of a training is divided among its parts without a remainder."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from bench_scripts import SCRIPTS, TINY


def test_the_shares_of_the_parts_add_up(tmp_path: Path) -> None:
    """In a separate process: the script replaces a class of the package."""
    words = ["experiment=medium", "--json", "spent.json", *TINY]
    command = [sys.executable, SCRIPTS / "bench/time_spent.py", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    spent = json.loads((tmp_path / "spent.json").read_text())
    shares = {kind: each["share"] for kind, each in spent.items()}
    assert set(shares) == {"stepping", "updating", "evaluating", "the rest", "compiling"}
    assert sum(shares.values()) == pytest.approx(1)
    assert min(spent[kind]["seconds"] for kind in ("stepping", "evaluating", "the rest")) > 0
