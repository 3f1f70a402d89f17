"""Curves and pictures of a run on Weights & Biases, over the number of transitions.

The environment variables of wandb hold, such as `WANDB_PROJECT` and `WANDB_MODE=offline`. The jobs of a sweep
are a group. A resumed run goes on in the same run of wandb; points after its checkpoint then stand twice.
"""

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from PIL import Image

from cartpole_rl.errors import ConfigError, reason_of
from cartpole_rl.reporting.loggers import flatten, library, sweep_of
from cartpole_rl.reporting.style import png

PROJECT, AXIS = "cartpole_rl", "transitions"
IDENTITY = "wandb_run.txt"  # in the run folder: the run of wandb


class WandbLog:
    """A run of Weights & Biases; its methods are those of `loggers.Logger`.

    Raises ConfigError where nobody is logged in.
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        self._wandb, file = library("wandb"), folder / IDENTITY
        try:
            self._run = self._wandb.init(
                project=os.environ.get("WANDB_PROJECT", PROJECT),
                name=folder.name,
                group=sweep_of(folder),
                dir=folder,
                id=file.read_text() if purge_step is not None and file.exists() else None,
                resume="allow",
                settings=self._wandb.Settings(silent=True, console="off"),
            )
        except self._wandb.errors.Error as error:
            raise ConfigError(f"logger=wandb: {reason_of(error)} Or set WANDB_MODE=offline") from None
        file.write_text(self._run.id)
        self._run.define_metric("*", step_metric=AXIS)

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Log one point of each curve; None is no point."""
        self._run.log({**{name: each for name, each in values.items() if each is not None}, AXIS: step})

    def histogram(self, name: str, values: ArrayLike, step: int) -> None:
        """Log the distribution of the finite `values`, of any shape."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        self._run.log({name: self._wandb.Histogram(flat[np.isfinite(flat)]), AXIS: step})

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """Log a figure as a picture."""
        self._run.log({name: self._wandb.Image(Image.open(io.BytesIO(png(figure)))), AXIS: step})

    def animation(self, name: str, gif: bytes, step: int) -> None:
        """Log an animation, the bytes of a GIF."""
        path = Path(self._run.dir) / f"{name.replace('/', '_')}_{step}.gif"
        path.write_bytes(gif)
        self._run.log({name: self._wandb.Video(str(path), format="gif"), AXIS: step})

    def hparams(self, config: Mapping[str, Any], metrics: Mapping[str, float | None]) -> None:
        """Log the settings, with dotted names, and the final metrics as the summary."""
        self._run.config.update(flatten(config), allow_val_change=True)
        self._run.summary.update({f"summary/{name}": each for name, each in metrics.items()})

    def flush(self) -> None:
        """Do nothing: wandb writes at once, in a process of its own."""

    def close(self) -> None:
        """Send or write the rest."""
        self._run.finish()
