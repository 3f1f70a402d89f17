"""Figures are written in the format that the path names, without pyplot."""

import subprocess
import sys

import pytest

from cartpole_rl.reporting.figures import (
    behaviour,
    save,
)
from cartpole_rl.tasks.episode import Episode


@pytest.mark.parametrize(("ending", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_save_writes_the_format_that_the_ending_names(
    tmp_path, balance: Episode, ending: str, magic: bytes
) -> None:
    path = save(behaviour(balance), tmp_path / "new" / f"picture.{ending}")
    assert path.read_bytes().startswith(magic)


def test_no_figure_needs_pyplot() -> None:
    code = (
        "import sys, cartpole_rl.reporting.figures as f;"
        "f.png(f.comparison({'a': [1.0, 2.0]}));"
        "sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
