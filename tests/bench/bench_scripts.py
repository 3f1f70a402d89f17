"""Makes the scripts of scripts/bench and scripts/fuzz importable."""

import sys
from collections.abc import Callable
from pathlib import Path

SCRIPTS = Path(__file__).parents[2] / "scripts"
TINY = ["learning.transitions=2048", "learning.carts=16", "learning.evaluations=2", "compile=false"]
Run = Callable[..., str]  # (script, folder, *words) -> output; the fixture `run`

sys.path[:0] = [str(SCRIPTS / "bench"), str(SCRIPTS / "fuzz")]
