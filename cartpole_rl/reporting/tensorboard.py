"""TensorBoard events of a run: scalars, histograms, figures, animations, its line on the HPARAMS page.

Pictures are stored as PNG or GIF: torch's `add_figure` uses pyplot, and its `add_video` writes nothing with
moviepy 2. All events go into one file: TensorBoard may ignore additions to an older file of the same folder
once it has read a newer one, and torch's `add_hparams` opens a second file.

A resumed run writes some points a second time. TensorBoard has a marker for that, torch's `purge_step`, but
only one of its three readers obeys it: the default reader replaces points only where new ones exist, and the
one of `--load_fast=false` shows both (TensorBoard 2.21). So the later points are removed from the files. Such
a file is a sequence of records: length u64 and its CRC u32, little-endian, the event, and its CRC u32.

No hparams "experiment" is written: with one, TensorBoard's HPARAMS page shows only its settings; without, it
collects the settings of all runs, those that differ first, and offers all curves as metrics.
"""

import io
import math
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from google.protobuf.message import DecodeError
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from PIL import Image
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import (
    DATA_CLASS_BLOB_SEQUENCE,
    DATA_CLASS_SCALAR,
    DATA_CLASS_TENSOR,
    Summary,
)
from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c
from torch.utils.tensorboard import FileWriter, summary

from cartpole_rl.errors import ConfigError
from cartpole_rl.files import replacing
from cartpole_rl.reporting.loggers import flatten
from cartpole_rl.reporting.style import png

BINS = 40
PLUGINS = {DATA_CLASS_SCALAR: "scalars", DATA_CLASS_TENSOR: "histograms", DATA_CLASS_BLOB_SEQUENCE: "images"}
FLUSH_SECONDS = 10  # largest age of what a running TensorBoard shows
FIGURE_DPI = 110  # sharp on a page, and a third of the bytes of a saved figure

LENGTH, CRC = struct.Struct("<Q"), struct.Struct("<I")
HPARAMS = "_hparams_/"  # prefix of the tags of TensorBoard's hparams plugin
FINAL = "summary/"  # prefix of final metrics, one point each; TensorBoard shows them last
OF_EPISODES = {
    "score": "Score (6.2) of an episode: the sum over its periods.",
    "score_upright": "Score (6.1) of an episode: the sum over its periods; only an upright pole scores.",
    "steps": "Control periods of an episode. Fewer than the time limit: it ended early.",
    "upright_fraction": "Share of an episode in which the pole is within 5 degrees of upright.",
    "track_guard_fraction": "Share of the periods in which the track guard replaced the agent's motor value.",
    "guarded_fraction": "Share of the periods in which the track guard replaced the agent's motor value.",
    "time_to_upright_s": "Seconds until the pole stays upright for one second.",
}
GROUPS = {
    "evaluation": "Mean over the episodes of an evaluation, without exploration, on nominal carts.",
    "exploration": "Mean over the training episodes that ended since the last point, with random actions.",
    "summary": "Mean over the episodes of the last evaluation.",
}
DESCRIPTIONS = {
    "evaluation/score": "Mean score (6.2) of the greedy policy on nominal carts: judge a training by it.",
    "evaluation/score_min": "Score of the worst episode of an evaluation: (6.2), of a balance (6.1).",
    "evaluation/score_max": "Score of the best episode of an evaluation: (6.2), of a balance (6.1).",
    "evaluation/seconds": "Seconds of training until this evaluation.",
    "exploration/episode_length": "Mean control periods of the episodes that ended since the last point.",
    "learning/loss": "Mean loss of the updates of an iteration.",
    "learning/gradient_norm": "Mean norm of the loss's gradient, before it is clipped.",
    "learning/learning_rate": "Learning rate of the optimizer.",
    "learning/q_mean": "Mean predicted return of the chosen actions: it should settle, not grow without end.",
    "learning/q_max": "Largest predicted return of the chosen actions.",
    "learning/epsilon": "Share of random actions in training.",
    "learning/updates": "Gradient steps so far.",
    "speed/transitions_per_second": "Transitions a second, collecting, learning and evaluating included.",
    "pictures/behaviour": "Position, angle and motor value of the first episode of an evaluation.",
    "pictures/cart": "Animation of the first episode of an evaluation, in real time.",
    "cart/score_before": "Score of each episode on the cart before fine-tuning: (6.2), of a balance (6.1).",
    "cart/score_tune": "Score of each episode that fine-tuning learns from, with random actions.",
    "cart/score_after": "Score of each episode on the cart after fine-tuning: (6.2), of a balance (6.1).",
    "cart/score_in_simulation": "Mean score of the agent on simulated carts drawn as in its training.",
    "link/frames_received": "Frames from the cart so far.",
    "link/bad_frames": "Damaged frames so far.",
    "link/lost_frames": "States that never arrived, so far.",
    "link/overtaken_frames": "States that arrived after a newer one, so far.",
    "link/repeated_frames": "States that arrived twice, so far.",
    "link/late_ticks": "States that were answered too late or not at all, so far; 0 is good.",
    "link/latency_samples": "Answers whose latency was measured.",
    "link/latency_median_ms": "Median time from a state's arrival to the end of its command, ms.",
    "link/latency_p99_ms": "99th percentile of that time, ms.",
    "link/latency_p999_ms": "99.9th percentile of that time, ms.",
    "link/latency_max_ms": "Longest such time, ms.",
}
PREFIXES = {
    "randomization/": "Distribution of this parameter over the simulated carts, in SI units.",
    "cart/guarded_": "Share of the periods of an episode in which the track guard replaced the motor value.",
}


class TensorBoardLog:
    """Writes one run folder's TensorBoard events; a context manager that flushes and closes on the way out.

    A resumed run gives `purge_step`, the first step that it writes again: points at that step and later are
    removed.
    """

    def __init__(self, folder: Path | str, purge_step: int | None = None) -> None:
        if purge_step is not None:
            cut_back(Path(folder), purge_step)
        try:
            self._writer = FileWriter(str(folder), flush_secs=FLUSH_SECONDS)
        except UnicodeEncodeError:
            raise ConfigError(
                f"logger=tensorboard, {folder}: this path is not UTF-8; give hydra.run.dir= another folder"
            ) from None

    def __enter__(self) -> "TensorBoardLog":
        return self

    def __exit__(self, *_: object) -> None:
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


def description(tag: str) -> str:
    """Return the description of a curve, a histogram or a picture; empty for an unknown one."""
    if tag in DESCRIPTIONS:
        return DESCRIPTIONS[tag]
    group, _, name = tag.partition("/")
    if group in GROUPS and name in OF_EPISODES:
        return f"{OF_EPISODES[name]} {GROUPS[group]}"
    return next((text for prefix, text in PREFIXES.items() if tag.startswith(prefix)), "")


def cut_back(folder: Path, first_step: int) -> None:
    """Remove points at `first_step` and later, and the final results, from the event files in `folder`.

    The final results are the line on the HPARAMS page and the final metrics; a resumed run writes them again.
    Other records stay, up to one that a killed run or a power cut damaged. Files are replaced atomically.
    """
    for path in sorted(folder.glob("events.out.tfevents.*")):
        rest = path.with_name(path.name.replace("tfevents", "rest"))  # which TensorBoard does not read
        with path.open("rb") as source, replacing(rest) as beside, beside.open("wb") as target:
            for record, event in _records(source):
                if _is_kept(event, first_step):
                    target.write(record)
        rest.replace(path)


def scalars(folder: Path, tag: str) -> list[tuple[int, float]]:
    """Return the points (step, value) of the curve `tag` in the event files in `folder`."""
    points = []
    for path in sorted(folder.glob("events.out.tfevents.*")):
        with path.open("rb") as source:
            for _, event in _records(source):
                points += [
                    (event.step, value.simple_value) for value in event.summary.value if value.tag == tag
                ]
    return points


def _records(source: BinaryIO) -> Iterator[tuple[bytes, Event]]:
    """Yield the records before the first one that is incomplete or damaged, each with its event.

    The CRC of the content is computed for the last one alone: it takes 0.2 s for a megabyte.
    """
    head = body = footer = b""
    while True:
        length, mark = source.read(LENGTH.size), source.read(CRC.size)
        goes_on = _is_whole(length, mark)
        if head and (goes_on or _is_whole(body, footer)):
            try:
                yield head + body + footer, Event.FromString(body)
            except DecodeError:
                return
        if not goes_on:
            return
        head, body, footer = length + mark, source.read(*LENGTH.unpack(length)), source.read(CRC.size)


def _is_whole(content: bytes, crc: bytes) -> bool:
    """Return True if `crc` is the CRC of `content`."""
    return crc == CRC.pack(masked_crc32c(content))


def _is_kept(event: Event, first_step: int) -> bool:
    """Return True for an event before `first_step` that is not a final result."""
    tags = [value.tag for value in event.summary.value]
    is_final = any(tag.startswith((HPARAMS, FINAL)) for tag in tags)
    return event.step < first_step and not is_final
