"""Scores of an agent on several carts: episodes, their mean with its 95 % interval, ratio to the first.

Figures 6.8 and 6.14 of the thesis show the ratio of the real to the simulated score.
"""

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from cartpole_rl.errors import ConfigError
from cartpole_rl.intervals import student_interval
from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures.annotations import guide, plain
from cartpole_rl.reporting.table import interval_text

DOTS = -0.15  # offset of a column's dots, in columns
MEAN = 0.12  # offset of its mean and interval
SPREAD = 0.11  # half width of the cloud of dots
BOX = 0.07  # half width of a mean's line and of the box that is its interval

Interval = tuple[float, float]
Array = NDArray[np.float64]


def comparison(
    results: Mapping[str, ArrayLike],
    title: str = "The same agent on each cart",
    intervals: Mapping[str, Interval] | None = None,
    guides: Mapping[str, float] | None = None,
) -> Figure:
    """Draw each episode's score as a dot, the mean with a 95 % interval, and its ratio to the first mean.

    `results` maps a name, such as "simulated", to the scores of its episodes [episodes]. `intervals` maps a
    name to (low, high) of its mean; if it is missing, Student's t interval is drawn, and none for a single
    episode. `guides` names scores to draw as lines. Raises ConfigError for no result or one without episodes.
    """
    scores = {name: np.asarray(values, dtype=np.float64).ravel() for name, values in results.items()}
    if not scores or not all(each.size for each in scores.values()):
        raise ConfigError("a comparison needs at least one result, and at least one episode in each")
    figure = style.new_figure(height=4.6, width=max(5.0, 1.6 + 1.9 * len(scores)))
    axes = figure.subplots()
    style.dress(axes, grid="y")
    for name, score in (guides or {}).items():
        guide(axes, score, name)
    for column, (name, each) in enumerate(scores.items()):
        interval = (intervals or {}).get(name) or student_interval(each)
        _draw_result(axes, column, each, interval)
    _name_columns(axes, scores)
    low, high = min(0.0, axes.get_ylim()[0]), axes.get_ylim()[1]
    axes.set_ylim(low, high + 0.05 * (high - low))  # else dots that lie close together are cut at the top
    style.label(axes, y="score of an episode")
    style.title(axes, plain(title), "dots: episodes,  line and box: their mean and its 95 % interval")
    return figure


def _draw_result(axes: Axes, column: int, scores: Array, interval: Interval) -> None:
    """Draw one column: the dots, and next to them the mean with its interval."""
    colour = style.series_colour(column)
    axes.plot(
        column + DOTS + _sideways(scores.size),
        np.sort(scores),
        "o",
        color=colour,
        alpha=0.5,
        markersize=5,
        markeredgewidth=0,
    )
    mean, (low, high) = float(scores.mean()), interval
    edges = [column + MEAN - BOX, column + MEAN + BOX]
    if math.isfinite(low) and math.isfinite(high):
        axes.fill_between(edges, low, high, color=colour, alpha=0.35, linewidth=0)
    axes.plot(edges, [mean, mean], color=colour, linewidth=2.5, solid_capstyle="butt")
    axes.annotate(
        interval_text(mean, low, high),
        xy=(column + MEAN + BOX, mean),
        xytext=(5, 0),
        textcoords="offset points",
        va="center",
        fontsize=style.LABEL_SIZE,
        color=style.INK,
    )


def _sideways(episodes: int) -> Array:
    """Return offsets [episodes] in columns that keep neighbours of the sorted scores apart."""
    golden = (math.sqrt(5) - 1) / 2  # multiples of it modulo 1 fill an interval evenly
    places: Array = SPREAD * (2 * ((np.arange(episodes, dtype=np.float64) * golden + 0.5) % 1) - 1)
    return places


def _name_columns(axes: Axes, scores: Mapping[str, Array]) -> None:
    """Label each column with its name, its number of episodes, and its ratio to the first column."""
    first = float(next(iter(scores.values())).mean())
    names = []
    for column, (name, each) in enumerate(scores.items()):
        count = "1 episode" if each.size == 1 else f"{each.size} episodes"
        ratio = f"\n{each.mean() / first:.2f} × {next(iter(scores))}" if column and first else ""
        names.append(plain(f"{name}\n{count}{ratio}"))
    axes.set_xticks(range(len(names)), names, fontsize=style.LABEL_SIZE, color=style.INK)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.5, len(names) - 0.3)
