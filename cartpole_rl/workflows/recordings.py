"""Where runs keep recordings, without reading them."""

from pathlib import Path

from cartpole_rl.errors import RecordingError
from cartpole_rl.workflows.run_folder import check_program

RECORDINGS = "recordings"
RECORDING = ("record", "identify", "finetune")  # commands whose runs hold recordings


def recordings(source: Path) -> list[Path]:
    """The recordings that `source` means: itself, those in it, or those of a run.

    Raises RecordingError, and ConfigError where it is a run of a command that records nothing.
    """
    if source.is_file():
        return [source]
    check_program("from", source, *RECORDING)
    inner = source / RECORDINGS
    found = sorted((inner if inner.is_dir() else source).glob("*.csv"))
    if not found:
        missing = "it holds no recording" if source.exists() else "there is no such file or folder"
        raise RecordingError(f"from={source}: {missing}; give what cartpole-record wrote")
    return found


def experiments(source: Path) -> dict[str, Path]:
    """Recordings by the names of their experiments, or of their files. Raises RecordingError, ConfigError."""
    check_program("from", source, *RECORDING)
    inner = source / RECORDINGS
    paths = sorted((inner if inner.is_dir() else source).glob("*.csv"))
    if not paths:
        missing = "it holds no recording" if source.exists() else "there is no such folder"
        raise RecordingError(f"from={source}: {missing}; give a run of cartpole-identify or cartpole-record")
    return {path.stem.partition("_")[2] or path.stem: path for path in paths}
