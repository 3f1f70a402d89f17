"""Runs scripts in this process, so that PyTorch is imported once, and trains one agent a little."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
from bench_scripts import TINY, Run


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a script's `main` with words in a folder; return its output."""

    def call(script: ModuleType, folder: Path, *words: str) -> str:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", [f"{script.__name__}.py", *words])
        script.main()
        return capsys.readouterr().out

    return call


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which one seed of the medium pole was trained a little and judged."""
    import learning

    folder = tmp_path_factory.mktemp("bench")
    words = ["learning.py", "medium", "--seeds", "1", "--json", "learning.json", *TINY]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(learning, "DRAWN_CARTS", 50)
        patch.setattr(sys, "argv", words)
        learning.main()
    return folder
