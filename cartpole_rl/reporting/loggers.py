"""Loggers: where the curves and pictures of a training go, one place or several.

A logger of one's own is a class that is made as `Logger` is, chosen as `logger=module:Name`.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cartpole_rl.errors import ConfigError
from cartpole_rl.registry import Extension, Registry
from cartpole_rl.run_folder import MULTIRUN
from cartpole_rl.terminal import print_message

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
LOGGERS.add("wandb", "cartpole_rl.reporting.trackers:WandbLog")
LOGGERS.add("mlflow", "cartpole_rl.reporting.trackers:MlflowLog")


class Loggers:
    """Several loggers of one run; each method of `Logger` is that of each of them, in their order.

    A resumed run goes on without a logger that raises ConfigError, with a warning.
    """

    def __init__(self, kinds: Sequence[Extension], folder: Path, purge_step: int | None = None) -> None:
        self._each: list[Logger] = []
        for kind in dict.fromkeys(kinds):
            try:
                self._each.append(kind(folder, purge_step))
            except BaseException as error:
                if purge_step is None or not isinstance(error, ConfigError):
                    with suppress(Exception), closing(self):
                        self.fail(error)
                    raise
                print_message("train", f"warning: {error}; the run goes on without it")

    def fail(self, error: BaseException) -> None:
        """Call `fail` of the loggers that have it, before `close`: `error` ends the run."""
        for logger in self._each:
            if tell := getattr(logger, "fail", None):
                tell(error)

    def close(self) -> None:
        """Close each of them, also where one before it raises."""
        with ExitStack() as stack:
            for logger in reversed(self._each):  # a stack
                stack.callback(logger.close)

    def __getattr__(self, name: str) -> Any:
        if name not in vars(Logger):
            raise AttributeError(name)

        def each(*arguments: Any) -> None:
            for logger in self._each:
                getattr(logger, name)(*arguments)

        return each


def library(name: str) -> Any:
    """Return the module of the logger `name`. Raises ConfigError where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        raise ConfigError(f"logger={name} needs {name}: pip install {name}") from None


def sweep_of(folder: Path) -> str | None:
    """Return the name of the sweep that the run in `folder` is a job of, if it is one."""
    parent = folder.resolve().parent
    return parent.name if (parent / MULTIRUN).exists() else None


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, float | str]:
    """Return nested settings as dotted names with plain values: finite numbers stay, all else becomes text.

    True, False and None become "true", "false" and "none": torch stores booleans as numbers and drops None.
    TensorBoard cannot read numbers that are not finite.
    """
    flat: dict[str, float | str] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(flatten(value, f"{name}."))
        else:
            flat[name] = _plain(value)
    return flat


def _plain(value: Any) -> float | str:
    """Return one setting as a number or as text."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float) and math.isfinite(value):
        return value
    return str(value)
