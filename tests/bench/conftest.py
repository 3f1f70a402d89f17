"""Trains one agent a little, for the benchmarks that judge agents."""

import sys
from pathlib import Path

import pytest
from bench_scripts import TINY
from bench_scripts import run as run


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
