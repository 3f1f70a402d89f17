"""Scores of an agent: tables for the terminal, learning curves, and comparisons of carts.

The learning curve is figure 6.9 of the thesis; figures 6.8 and 6.14 show the ratio of the real to the
simulated score.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cartpole_rl.drawing import colours
from cartpole_rl.reporting import style
from cartpole_rl.reporting.texts import count_text, interval_text, table
from cartpole_rl.tasks.settings import Measure

SCORES = {  # key in metrics.json: label
    "score": "score (6.2)",
    "score_upright": "score upright (6.1)",
    "time_to_upright_s": "time to upright, s",
    "upright_fraction": "share of time upright",
    "rms_angle_rad": "RMS angle while upright, rad",
    "rms_position_m": "RMS position while upright, m",
    "min_track_margin_m": "nearest to the track's end, m",
    "guarded_fraction": "share of time under the track guard",  # None without a guard
}
MILLION = 1e6
DOTS = -0.15  # offset of a column's dots, in columns
MEAN = 0.12  # offset of its mean and interval
SPREAD = 0.11  # half width of the cloud of dots
BOX = 0.07  # half width of a mean's line and of the box that is its interval

Array = NDArray[np.float64]


def score_table(summary: Mapping[str, Any], heading: str) -> str:
    """Return a table of the means in a summary of episodes (`evaluation.metrics.summarize`)."""
    return score_columns({"mean": summary}, heading)


def score_columns(summaries: Mapping[str, Mapping[str, Any]], heading: str) -> str:
    """Return a table with a column of means for each summary, by its name.

    The intervals of a row have one form: by their ends if one of them is asymmetric.
    """
    rows = []
    for key, label in SCORES.items():
        means = {name: summary[key] for name, summary in summaries.items()}
        if any(mean is not None for mean in means.values()):
            texts = {name: mean_text(mean) for name, mean in means.items()}
            if any(" to " in (text or "") for text in texts.values()):
                texts = {name: mean_text(mean, ends=True) for name, mean in means.items()}
            rows.append({"figure": label, **texts})
    return table(rows, {"figure": heading, **{name: name for name in summaries}})


def mean_text(value: Mapping[str, Any] | None, ends: bool = False) -> str | None:
    """Return a mean with its interval, by its `ends` or as `interval_text` chooses; None without one."""
    return None if value is None else interval_text(value["mean"], value["low"], value["high"], ends)


def learning_curve(history: Sequence[Mapping[str, Any]], measure: Measure) -> Figure:
    """Draw the mean of each evaluation over millions of transitions, in a band from worst to best episode.

    Each record of `history`, one or more, has `transitions`, and over the episodes of that evaluation the
    `measure` (mean), `score_min` and `score_max`.
    """
    figure = style.new_figure(height=4.4)
    axes = figure.subplots()
    style.dress(axes, x="transitions (millions)", y=f"{SCORES[measure]} of an episode")
    keys = ("transitions", measure, "score_min", "score_max")
    transitions, means, lowest, highest = np.array([[each[key] for key in keys] for each in history], float).T
    millions, colour = transitions / MILLION, style.series_colour(0)
    axes.fill_between(millions, lowest, highest, color=colour, alpha=0.13, linewidth=0)
    marker = "o" if len(millions) == 1 else ""
    axes.plot(millions, means, marker=marker, color=colour, linewidth=2.2, label=measure)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, steps=(1, 2, 5, 10)))
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))
    axes.legend(loc="lower right", fontsize=style.SMALL_SIZE, frameon=True, framealpha=0.9, edgecolor="none")
    style.title(axes, "Learning curve", "line: mean,  band: worst to best episode")
    return figure


def comparison(results: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw each episode's score as a dot, the mean with a 95 % interval, and its ratio to the first mean.

    `results` maps a name, such as "simulated", to the content of a metrics.json.
    """
    scores = {name: np.array([e["score"] for e in result["episodes"]]) for name, result in results.items()}
    figure = style.new_figure(height=4.6, width=max(5.0, 1.6 + 1.9 * len(scores)))
    axes = figure.subplots()
    style.dress(axes, y="score of an episode", grid="y")
    for column, (name, result) in enumerate(results.items()):
        _draw_result(axes, column, scores[name], result["score"])
    _name_columns(axes, scores)
    low, high = min(0.0, axes.get_ylim()[0]), axes.get_ylim()[1]
    axes.set_ylim(low, high + 0.05 * (high - low))  # else dots that lie close together are cut at the top
    subtitle = "dots: episodes,  line and box: their mean and its 95 % interval"
    style.title(axes, "The same agent on each cart", subtitle)
    return figure


def _draw_result(axes: Axes, column: int, scores: Array, mean: Mapping[str, Any]) -> None:
    """Draw one column: the dots, and next to them the mean with its interval."""
    colour, places = style.series_colour(column), column + DOTS + _sideways(scores.size)
    axes.plot(places, np.sort(scores), "o", color=colour, alpha=0.5, markersize=5, markeredgewidth=0)
    edges, height = [column + MEAN - BOX, column + MEAN + BOX], mean["mean"]
    if mean["low"] is not None:
        axes.fill_between(edges, mean["low"], mean["high"], color=colour, alpha=0.35, linewidth=0)
    axes.plot(edges, [height, height], color=colour, linewidth=2.5, solid_capstyle="butt")
    text, place = mean_text(mean) or "", (edges[1], height)
    style.note(axes, text, place, "data", (5, 0), va="center", fontsize=style.LABEL_SIZE)


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
        ratio = f"\n{each.mean() / first:.2f} × {next(iter(scores))}" if column and first else ""
        names.append(style.plain(f"{name}\n{count_text(each.size)}{ratio}"))
    axes.set_xticks(range(len(names)), names, fontsize=style.LABEL_SIZE, color=colours.INK)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.5, len(names) - 0.3)
