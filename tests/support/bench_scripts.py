"""Runs the scripts of scripts/bench and scripts/fuzz in this process.

PyTorch takes seconds to import, so a process for each script would take longer than most of the scripts.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
TINY = ["learning.transitions=2048", "learning.warmup_transitions=64", "learning.carts=16"]
TINY += ["learning.evaluations=2", "compile=false"]
Run = Callable[..., str]  # (script, folder, *words) -> output; the fixture `run`


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a script's `main` with words in a folder; return its output."""

    def call(script: ModuleType, folder: Path, *words: str) -> str:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", [f"{script.__name__}.py", *words])
        script.main()
        return capsys.readouterr().out

    return call
