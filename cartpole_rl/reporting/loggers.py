"""Loggers: where the curves and pictures of a training go, TensorBoard or a logger of one's own.

A logger of one's own is a class that is made as `Logger` is, chosen as `logger=module:Name`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cartpole_rl.registry import Extension, Registry

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike


class Logger(Protocol):
    """A logger of one run; `step` counts transitions."""

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        """Log the run in `folder`. A resumed run gives the first step that it logs again, a new one None."""

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Log one point of each curve; None is no point."""

    def histogram(self, name: str, values: "ArrayLike", step: int) -> None:
        """Log the distribution of `values`, of any shape."""

    def figure(self, name: str, figure: "Figure", step: int) -> None:
        """Log a figure of matplotlib."""

    def animation(self, name: str, gif: bytes, step: int) -> None:
        """Log an animation, the bytes of a GIF."""

    def hparams(self, config: Mapping[str, Any], metrics: Mapping[str, float | None]) -> None:
        """Log the settings, nested mappings, and the final metrics; called once, at the end of a run."""

    def flush(self) -> None:
        """Write everything; called before each checkpoint."""

    def close(self) -> None:
        """Flush, and release what is open; nothing is logged afterwards."""


def _check_logger(item: Any) -> None:
    missing = [name for name in vars(Logger) if not name.startswith("_") and not hasattr(item, name)]
    if missing:
        raise ValueError(f"it has no `{missing[0]}`")


LOGGERS: Registry[Extension] = Registry("logger", __name__, check=_check_logger)
LOGGERS.add("tensorboard", "cartpole_rl.reporting.tensorboard:TensorBoardLog")
