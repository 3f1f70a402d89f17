"""The evaluations of a training so far, a line each in its run folder."""

import json
from collections.abc import Sequence
from pathlib import Path

from cartpole_rl.files import write_text
from cartpole_rl.run_files import HISTORY


def read_history(folder: Path) -> list[dict[str, float]]:
    """Return the evaluations of a training so far, oldest first."""
    path = folder / HISTORY
    return (
        [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    )


def write_history(folder: Path, history: Sequence[dict[str, float]]) -> None:
    """Write the evaluations for `read_history`, all or none."""
    write_text(folder / HISTORY, "".join(json.dumps(record) + "\n" for record in history))
