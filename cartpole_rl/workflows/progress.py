"""Progress bars on stderr. Only a terminal gets one: a pipe or a log file would keep every repaint."""

import sys
from typing import Any

from tqdm import tqdm


def progress_bar(total: int, unit: str, **options: Any) -> "tqdm[Any]":
    """Return a bar of `total` units that is as wide as the terminal; options as for tqdm."""
    return tqdm(total=total, unit=f" {unit}", dynamic_ncols=True, disable=not is_terminal(), **options)


def is_terminal() -> bool:
    """Return True if stderr is a terminal."""
    return sys.stderr is not None and sys.stderr.isatty()
