"""TensorBoard events of a run: scalars, histograms, figures, animations, its line on the HPARAMS page.

Pictures are stored as PNG or GIF: torch's `add_figure` uses pyplot, and its `add_video` writes nothing with
moviepy 2. All events go into one file: TensorBoard may ignore additions to an older file of the same folder
once it has read a newer one, and torch's `add_hparams` opens a second file.

No hparams "experiment" is written: with one, TensorBoard's HPARAMS page shows only its settings; without, it
collects the settings of all runs, those that differ first, and offers all curves as metrics.
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
from tensorboard.compat.proto.summary_pb2 import (
    DATA_CLASS_BLOB_SEQUENCE,
    DATA_CLASS_SCALAR,
    DATA_CLASS_TENSOR,
    Summary,
)
from torch.utils.tensorboard import FileWriter, summary

from cartpole_rl.reporting.descriptions import description
from cartpole_rl.reporting.events import FINAL, cut_back
from cartpole_rl.reporting.figures import png

BINS = 40
PLUGINS = {DATA_CLASS_SCALAR: "scalars", DATA_CLASS_TENSOR: "histograms", DATA_CLASS_BLOB_SEQUENCE: "images"}
FLUSH_SECONDS = 10  # largest age of what a running TensorBoard shows
FIGURE_DPI = 110  # sharp on a page, and a third of the bytes of a saved figure


class TensorBoardLog:
    """Writes one run folder's TensorBoard events; a context manager that flushes and closes on the way out.

    A resumed run gives `purge_step`, the first step that it writes again: points at that step and later are
    removed.
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
        """Flush and close the file. Nothing can be logged afterwards."""
        self._writer.close()

    def flush(self) -> None:
        """Write everything to disk, so that a running TensorBoard shows it."""
        self._writer.flush()

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Log one point of each curve at `step`; None is skipped."""
        for name, value in values.items():
            if value is not None:
                point = summary.scalar(name, float(value))
                self._writer.add_summary(described(point, DATA_CLASS_SCALAR), step)

    def histogram(self, name: str, values: ArrayLike, step: int) -> None:
        """Log the distribution of the finite `values`, of any shape."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        flat = flat[np.isfinite(flat)]
        if flat.size:
            histogram = summary.histogram(name, flat, bins=BINS)
            self._writer.add_summary(described(histogram, DATA_CLASS_TENSOR), step)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """Log a figure as a picture."""
        self._picture(name, png(figure, FIGURE_DPI), step)

    def animation(self, name: str, gif: bytes, step: int) -> None:
        """Log the bytes of a GIF; the IMAGES page plays it."""
        self._picture(name, gif, step)

    def hparams(self, config: Mapping[str, Any], metrics: Mapping[str, float | None], step: int = 0) -> None:
        """Log the run's line on the HPARAMS page, once at the end of a run.

        `config` may be nested: `{"agent": {"gamma": 0.99}}` becomes `agent.gamma`, a list its text. The final
        `metrics` become points of curves named `summary/...` at `step`; those that are None or not finite are
        skipped.
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
        """Log the bytes of a PNG or GIF file, unchanged."""
        with Image.open(io.BytesIO(encoded)) as picture:
            width, height = picture.size
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=encoded)
        value = Summary(value=[Summary.Value(tag=name, image=image)])
        self._writer.add_summary(described(value, DATA_CLASS_BLOB_SEQUENCE), step)


def described(points: Summary, data_class: int) -> Summary:
    """Return `points` with the descriptions that TensorBoard shows beside their names.

    With a description alone, its fast reader would not know the class of the data and drop them.
    """
    for value in points.value:
        value.metadata.summary_description = description(value.tag)
        value.metadata.data_class = data_class
        value.metadata.plugin_data.plugin_name = PLUGINS[data_class]
    return points


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
