"""What a run writes for TensorBoard: scalars, histograms, figures, animations, its line on the HPARAMS page.

Pictures are stored as the PNG or GIF that they are: torch's `add_figure` goes through pyplot, and its
`add_video` writes nothing with moviepy 2. Everything goes into one file: TensorBoard may ignore what is added
to an older file of the same folder once it has seen a newer one, so torch's `add_hparams`, which opens a
second file, is not used.

On the HPARAMS page TensorBoard takes the settings to show from the first "experiment" that it meets, and so
hides those that only other runs have. Without any, it collects them from all runs and shows first those that
differ; so none is written, and the metrics to choose from are then all curves.
"""

import io
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from PIL import Image
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import FileWriter, summary

from cartpole_rl.reporting.events import FINAL, cut_back
from cartpole_rl.reporting.figures import png

BINS = 40
FLUSH_SECONDS = 10  # how old at most the page of somebody who watches is
FIGURE_DPI = 110  # sharp on a page, and a third of the bytes of a saved figure


class TensorBoardLog:
    """Writes one run folder's TensorBoard events; a context manager that flushes and closes on the way out.

    `purge_step` is for a run that goes on: the first step that it writes again. Points at that step and
    later, from before it was killed, disappear; earlier ones stay. A new run leaves it out.
    """

    def __init__(self, folder: Path | str, purge_step: int | None = None) -> None:
        if purge_step is not None:
            cut_back(Path(folder), purge_step)
        self._writer = FileWriter(str(folder), flush_secs=FLUSH_SECONDS)

    def __enter__(self) -> "TensorBoardLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Flush and close the file; the log is of no use afterwards."""
        self._writer.close()

    def flush(self) -> None:
        """Bring everything to disk, so that a TensorBoard that is looking on shows it."""
        self._writer.flush()

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """One point of each curve at `step`; None is left out."""
        for name, value in values.items():
            if value is not None:
                self._writer.add_summary(summary.scalar(name, float(value)), step)

    def histogram(self, name: str, values: ArrayLike, step: int) -> None:
        """The distribution of `values`, of any shape; what is not finite is left out."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        flat = flat[np.isfinite(flat)]
        if flat.size:
            self._writer.add_summary(summary.histogram(name, flat, bins=BINS), step)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """A figure as a picture."""
        self._picture(name, png(figure, FIGURE_DPI), step)

    def animation(self, name: str, gif: bytes, step: int) -> None:
        """The bytes of a GIF; the IMAGES page plays it."""
        self._picture(name, gif, step)

    def hparams(self, config: Mapping[str, Any], metrics: Mapping[str, float | None], step: int = 0) -> None:
        """The run's line on the HPARAMS page; once a run, at its end.

        `config` may be nested: `{"agent": {"gamma": 0.99}}` becomes `agent.gamma`, a list its text. `metrics`
        is what came out in the end, stored as points of curves named `Final/...` at `step`; None and what is
        not finite are left out.
        """
        final = {
            FINAL + name: float(value)
            for name, value in metrics.items()
            if value is not None and math.isfinite(value)
        }
        _, start, end = summary.hparams(flatten(config), final)
        self._writer.add_summary(start, step)
        self._writer.add_summary(end, step)
        self.scalars(final, step)

    def _picture(self, name: str, encoded: bytes, step: int) -> None:
        """The bytes of a PNG or GIF file as they are."""
        with Image.open(io.BytesIO(encoded)) as picture:
            width, height = picture.size
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=encoded)
        self._writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, float | str]:
    """Nested settings as dotted names with plain values: numbers stay, everything else becomes its text.

    True and False become "true" and "false" and None becomes "none", since torch stores a truth value as a
    number and drops None. Numbers that are not finite become text too: TensorBoard's page cannot read them.
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
    """One setting as TensorBoard shows it best."""
    if value is None or isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float) and math.isfinite(value):
        return value
    return str(value)
