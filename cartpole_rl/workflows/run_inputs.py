"""What the runs that a run needs had found when it started: agents, identified carts, learned models."""

import json
import os
from collections.abc import Iterable
from pathlib import Path

from cartpole_rl.run_files import CHECKPOINTS, IDENTIFIED, LAST, MODELLED
from cartpole_rl.workflows.run_folder import file_hash, write_json

INPUTS = "inputs.json"  # hashes of files, which are named as seen from the run folder
FOUND = (Path(CHECKPOINTS, LAST), Path(IDENTIFIED), Path(MODELLED))


def write_inputs(folder: Path, needs: Iterable[Path]) -> None:
    """Write the hashes of what the runs `needs` have found into the run folder."""
    files = [need / name for need in needs for name in FOUND if (need / name).is_file()]
    hashes = {Path(os.path.relpath(file, folder)).as_posix(): file_hash(file) for file in files}
    write_json(folder / INPUTS, hashes)


def is_outdated(folder: Path) -> bool:
    """Return True if a run that the run in `folder` needs was made again since, with another result."""
    try:
        recorded = dict(json.loads((folder / INPUTS).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return False
    there = {folder / name: was for name, was in recorded.items() if (folder / name).is_file()}
    return any(file_hash(file) != was for file, was in there.items())
