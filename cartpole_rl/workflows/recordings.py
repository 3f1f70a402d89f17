"""Finds recordings in run folders, without reading them."""

import re
from pathlib import Path

from cartpole_rl.errors import RecordingError
from cartpole_rl.run_folder import RECORDINGS, check_program

RECORDING = ("record", "identify", "finetune")  # commands whose runs hold recordings


def recordings(source: Path) -> list[Path]:
    """Return `source` itself if it is a file, else the recordings in that folder or run folder.

    Raises RecordingError if there is none, and ConfigError for a run of a command that records nothing.
    """
    if source.is_file():
        return [source]
    check_program("from", source, *RECORDING)
    inner = source / RECORDINGS
    found = sorted((inner if inner.is_dir() else source).glob("*.csv"))
    if not found:
        missing = "it contains no recording" if source.exists() else "there is no such file or folder"
        raise RecordingError(f"from={source}: {missing}; give a run of cartpole-record or cartpole-identify")
    return found


def experiments(source: Path) -> dict[str, Path]:
    """Return `recordings` by the names of their experiments, or of their files. Raises the same errors."""
    return {re.sub(r"^\d\d_(?=.)", "", path.stem): path for path in recordings(source)}
