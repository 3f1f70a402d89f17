"""Atomic writing of files: complete or absent, even after a kill or a power cut. One writer in a folder."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cartpole_rl.errors import ConfigError

try:
    import fcntl
except ImportError:  # Windows has no locks of folders
    fcntl = None  # type: ignore[assignment]

FULL = {errno.ENOSPC, errno.EDQUOT}  # errors of writing: the disk is full, or a user's share of it


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; at the end, it replaces `path` atomically.

    Content and new name are flushed to the disk, in this order, before this returns. After an error the
    temporary file is removed, and `path` is as before. An OSError that names no file, as that of a full disk,
    becomes one that names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.partial")
    try:
        yield beside
        _flush(beside)
        beside.replace(path)
    except BaseException as error:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        if unnamed := _unnamed(error):
            raise OSError(unnamed.errno, unnamed.strerror, str(path)) from error
        raise
    if os.name == "posix":  # Windows cannot open a folder
        _flush(path.parent)


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make `folder` and keep it for this process: two that write into it would damage its files.

    Raises ConfigError if another process has it, or if it is a file. The claim ends with the process, however
    that ends. Windows and file systems without locks know no claims.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise ConfigError(f"{folder}: this path, or a part of it, is a file; give another folder") from None
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"another process works in {folder}; wait for its end, or stop it") from None
        except OSError:  # no locks
            pass
        yield
    finally:
        os.close(descriptor)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait for the lock on the file `path`, which is made, and keep it; where there are no locks, go on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        with suppress(OSError, AttributeError):  # no locks, no `fcntl`
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` atomically, in UTF-8; bytes of file names that are none are escaped."""
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` to `path` atomically."""
    with replacing(path) as beside:
        beside.write_bytes(content)


def _unnamed(error: BaseException) -> OSError | None:
    """Return the OSError without a file that `error` is, or that torch.save hides behind `error`."""
    cause = error.__context__ if isinstance(error, RuntimeError) else error
    return cause if isinstance(cause, OSError) and cause.errno and not cause.filename else None


def _flush(path: Path) -> None:
    """Wait until the content of `path`, a file or a folder, is on the disk."""
    flags = os.O_RDONLY if path.is_dir() else os.O_RDWR  # Windows flushes only what it may write
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
