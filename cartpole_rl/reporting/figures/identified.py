"""Figures of an identification: laws with their uncertainty, intervals, experiments, what the data tell.

The first redoes figures 5.2, 5.3 and 5.5 of the thesis: friction over speed, force over motor value.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures.behaviours import wrapped_line
from cartpole_rl.reporting.table import interval_text, number_text
from cartpole_rl.tasks.episode import Episode

FOUND, BEFORE, SIMULATED = style.BLUE, style.MUTED, style.VERMILLION
TAIL = 2.5  # percent beyond each end of an interval
LONGEST = 14.0  # s of an experiment that are drawn
TOLD = 0.05  # of a component, from which its name is written

Array = NDArray[np.floating]


class Law(NamedTuple):
    """A curve with what it may be: `over` [S], `best` [S], `drawn` [S, N], `before` [S]."""

    over: Array
    best: Array
    drawn: Array
    before: Array


class Known(NamedTuple):
    """One quantity: value, ends of its interval, and what was thought of it before."""

    words: str
    unit: str
    value: float
    low: float
    high: float
    before: float


class Course(Protocol):
    """An episode beside its replay; see `identification.replay.Replayed`."""

    @property
    def episode(self) -> Episode: ...  # noqa: D102
    @property
    def time(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def x(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def theta(self) -> NDArray[np.float64]: ...  # noqa: D102


def laws_figure(friction: Law, force: Law) -> Figure:
    """Friction of the cart (N) over its speed (m/s), and force (N) over motor value, with 95 % bands."""
    figure = style.new_figure(height=4.4)
    left, right = figure.subplots(1, 2)
    for axes, law, x, y, heading in (
        (left, friction, "speed of the cart (m/s)", "friction (N)", "Friction"),
        (right, force, "motor value", "force on the cart (N)", "Force"),
    ):
        style.dress(axes)
        low, high = np.percentile(law.drawn, [TAIL, 100 - TAIL], axis=1)
        axes.fill_between(law.over, low, high, color=FOUND, alpha=0.25, linewidth=0)
        axes.plot(law.over, law.before, color=BEFORE, linestyle=(0, (4, 3)), label="thought before")
        axes.plot(law.over, law.best, color=FOUND, linewidth=2, label="found, with 95 %")
        style.label(axes, x=x, y=y)
        style.title(axes, heading)
    left.legend(fontsize=style.NOTE_SIZE, frameon=False, loc="upper left")
    return figure


def interval_figure(rows: Sequence[Known]) -> Figure:
    """Each quantity's 95 % interval, about its value in units of half that interval, and what was thought."""
    figure = style.new_figure(height=1.2 + 0.36 * len(rows))
    axes = figure.subplots()
    style.dress(axes, grid="x")
    farthest = 12.0
    for height, row in enumerate(reversed(rows)):
        half = max((row.high - row.low) / 2, 1e-12)
        axes.plot(
            [(row.low - row.value) / half, (row.high - row.value) / half],
            [height, height],
            color=FOUND,
            linewidth=5,
            alpha=0.4,
            solid_capstyle="butt",
        )
        axes.plot(0, height, "o", color=FOUND)
        away = (row.before - row.value) / half
        marker = "D" if abs(away) <= farthest else (">" if away > 0 else "<")
        axes.plot(np.clip(away, -farthest, farthest), height, marker, color=BEFORE, markersize=6)
        text = (
            f"{interval_text(row.value, row.low, row.high)} {row.unit}   (before {number_text(row.before)})"
        )
        axes.annotate(
            text,
            xy=(1, height),
            xycoords=("axes fraction", "data"),
            xytext=(8, 0),
            textcoords="offset points",
            va="center",
            fontsize=style.NOTE_SIZE,
            color=style.INK,
            annotation_clip=False,
        )
    axes.set_yticks(range(len(rows)), [row.words for row in reversed(rows)], fontsize=style.NOTE_SIZE)
    axes.set_xlim(-farthest - 1, farthest + 1)
    axes.set_xlabel("in half widths of the 95 % interval", fontsize=style.LABEL_SIZE, color=style.INK)
    note = "blue: found, with its interval,  grey: thought before"
    style.title(axes, "What was found", note)
    return figure


def experiments_figure(courses: Mapping[str, Course]) -> Figure:
    """Position (cm) and angle (deg from hanging) of each experiment over time (s), measured and simulated."""
    figure = style.new_figure(height=1.0 + 2.1 * len(courses), width=10.0)
    panels = figure.subplots(len(courses), 2, squeeze=False)
    for (left, right), (name, course) in zip(panels, courses.items(), strict=True):
        start = _liveliest(course.episode)
        _draw_course(left, course, start, angle=False)
        _draw_course(right, course, start, angle=True)
        style.title(left, name)
        style.label(left, y="cart (cm)")
        style.label(right, y="from hanging (deg)")
    for axes in panels[-1]:
        style.label(axes, x="time (s)")
    panels[0][1].legend(
        loc="upper right", ncols=2, fontsize=style.NOTE_SIZE, frameon=False, bbox_to_anchor=(1, 1.22)
    )
    return figure


def _liveliest(episode: Episode) -> float:
    """Where the LONGEST s begin in which the cart moves most, s."""
    way = np.concatenate((np.zeros(1), np.cumsum(np.abs(np.diff(episode.x)))))
    starts = episode.time[episode.time <= max(0.0, episode.time[-1] - LONGEST)]
    covered = np.interp(starts + LONGEST, episode.time, way) - np.interp(starts, episode.time, way)
    return float(starts[int(np.argmax(covered))])


def _draw_course(axes: Axes, course: Course, start: float, angle: bool) -> None:
    style.dress(axes)
    episode, colour = course.episode, style.POLE if angle else style.CART
    if angle:
        axes.plot(
            *wrapped_line(episode.time, episode.theta - np.pi),
            color=colour,
            linewidth=3,
            alpha=0.45,
            label="measured",
        )
        axes.set_yticks((-180, -90, 0, 90, 180))
        axes.set_ylim(-190, 190)
    else:
        axes.plot(episode.time, 100 * episode.x, color=colour, linewidth=3, alpha=0.55, label="measured")
    values = course.theta if angle else course.x
    for index, (moments, row) in enumerate(zip(course.time, values, strict=True)):
        known = np.isfinite(row)
        line = (
            wrapped_line(moments[known], row[known] - np.pi) if angle else (moments[known], 100 * row[known])
        )
        axes.plot(*line, color=SIMULATED, linewidth=1.1, label="simulated" if index == 0 else None)
    axes.set_xlim(start, min(start + LONGEST, float(episode.time[-1])))


def spectrum_figure(covariance: Array, names: Sequence[str]) -> Figure:
    """Combinations of numbers, the best known below: what is left of the uncertainty before, and their parts.

    `covariance` [U, U] is in units of the variance before; its eigenvectors are the combinations.
    """
    values, vectors = np.linalg.eigh(covariance)
    figure = style.new_figure(height=1.6 + 0.34 * len(names), width=11.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.7), sharey=True)
    rows = np.arange(len(values))
    style.dress(left, grid="x")
    left.barh(rows, np.sqrt(values), color=FOUND, alpha=0.7)
    left.axvline(1.0, color=BEFORE, linestyle=(0, (3, 3)))
    left.set_xscale("log")
    style.label(left, x="standard deviation left, of that before", y="combination")
    left.set_yticks(rows, [f"{row + 1}" for row in rows])
    style.title(left, "What the recordings tell", "at the dashed line: nothing")
    right.imshow(np.abs(vectors.T), aspect="auto", cmap="Blues", vmin=0, vmax=1, origin="lower")
    for row, column in zip(*np.nonzero(np.abs(vectors.T) > 0.3), strict=True):
        dark = abs(vectors[column, row]) > 0.6
        right.text(
            column,
            row,
            f"{vectors[column, row]:+.1f}",
            ha="center",
            va="center",
            fontsize=7,
            color=style.PAPER if dark else style.INK,
        )
    right.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=style.NOTE_SIZE)
    style.title(right, "Of which numbers", "weight of each in the combination")
    return figure
