"""Figures of studies: every agent as a dot, and the interquartile mean with its 95 % interval.

They are narrow, so that their text can be read on a phone; headings are those of the page.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cartpole_rl.reporting import style
from cartpole_rl.reporting.studies.statistics import (
    estimate,
    interquartile_mean,
    performance_profile,
    rank_correlation,
)
from cartpole_rl.reporting.table import number_text

WIDTH = 4.6  # inch
LINE = 0.21  # inch, of a row of dots and of a label
MOST_LINES = 8  # in a figure of curves
PROFILE_POINTS = 101
DOT, MEAN = 4.0, 7.0  # points
JITTER = 0.16  # of a row
HEIGHT = 2.9  # inch, of a panel of curves
LONGEST_LABEL = 48  # characters

Array = NDArray[np.float64]
Curve = Sequence[tuple[float, float]]


def cut(label: str) -> str:
    """Return a label that fits into a figure; the page's tables have the whole one."""
    return label if len(label) <= LONGEST_LABEL else label[: LONGEST_LABEL - 1].rstrip() + "…"


def dot_rows(
    groups: Mapping[str, Mapping[str, Array]], measure: str, guides: Mapping[str, float] | None = None
) -> Figure:
    """Draw the values of each group's series as a row of dots, with interquartile mean and interval.

    `groups` maps a label to its series, each an array [agents]; a series has one colour throughout.
    `guides` names values of `measure` to draw as vertical lines.
    """
    series = list(dict.fromkeys(name for group in groups.values() for name in group))
    lines = len(groups) + sum(len(group) for group in groups.values())
    figure = style.new_figure(height=LINE * (lines + 1) + 0.5 + _legend_height(series), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes, grid="x")
    axes.spines["left"].set_visible(False)
    height = 0.0
    for label, group in groups.items():
        axes.text(
            0,
            height,
            cut(label),
            transform=axes.get_yaxis_transform(),
            fontsize=style.SMALL_SIZE,
            color=style.INK,
            va="center",
            fontweight="bold",
        )
        for name, values in group.items():
            height += 1
            _draw_row(axes, height, values, style.series_colour(series.index(name)))
        height += 1
    for name, value in (guides or {}).items():
        _vertical_guide(axes, value, name)
    axes.set_ylim(height - 0.4, -0.8)
    axes.set_yticks([])
    _legend(axes, {name: style.series_colour(index) for index, name in enumerate(series)})
    style.label(axes, x=measure)
    return figure


def curves_over_axis(
    lines: Mapping[str, tuple[Sequence[float], Sequence[Array]]], axis: str, measure: str
) -> Figure:
    """Draw the interquartile mean over a quantity, with its interval as a band, and every agent as a dot.

    `lines` maps a label to the places [S] on the axis and the values there, S arrays [agents].
    """
    figure = style.new_figure(height=HEIGHT + _legend_height(lines), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    for index, (places, values) in enumerate(lines.values()):
        colour = style.series_colour(index)
        found = [estimate(each) for each in values]
        axes.plot(places, [each.value for each in found], color=colour, linewidth=2, marker="o", markersize=5)
        if all(each.low is not None for each in found):
            low, high = ([getattr(each, end) for each in found] for end in ("low", "high"))
            axes.fill_between(places, low, high, color=colour, alpha=0.2, linewidth=0)
        for place, each in zip(places, values, strict=True):
            axes.plot(np.full(each.size, place), each, "o", color=colour, alpha=0.45, markersize=3, mew=0)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    _legend(axes, {name: style.series_colour(index) for index, name in enumerate(lines)})
    style.label(axes, x=axis, y=measure)
    return figure


def profiles(groups: Mapping[str, Array], measure: str) -> Figure:
    """Draw the share of each group's agents [agents] above every score, with its 95 % band."""
    figure = style.new_figure(height=HEIGHT + _legend_height(groups), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    everything = np.concatenate(list(groups.values()))
    low, high = float(everything.min()), float(everything.max())
    margin = 0.05 * (high - low or 1.0)
    scores = np.linspace(low - margin, high + margin, PROFILE_POINTS)
    for index, values in enumerate(groups.values()):
        share, lower, upper = performance_profile(values, scores)
        colour = style.series_colour(index)
        axes.plot(scores, share, color=colour, linewidth=2)
        if values.size > 1:
            axes.fill_between(scores, lower, upper, color=colour, alpha=0.15, linewidth=0)
    axes.set_ylim(-0.02, 1.04)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    _legend(axes, {name: style.series_colour(index) for index, name in enumerate(groups)})
    style.label(axes, x=measure, y="share of agents above")
    return figure


def training_curves(groups: Mapping[str, Sequence[Curve]], name: str) -> Figure:
    """Draw a curve of each agent over its training as a thin line, and a group's median as a thick one."""
    figure = style.new_figure(height=HEIGHT + _legend_height(groups), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    for index, curves in enumerate(groups.values()):
        colour = style.series_colour(index)
        points = [np.array(curve, dtype=float).T for curve in curves]
        for transitions, values in points:
            axes.plot(transitions / 1e6, values, color=colour, alpha=0.45, linewidth=0.8)
        shared = points[0][0][points[0][0] <= min(each[0][-1] for each in points)]
        median = np.median([np.interp(shared, *each) for each in points], axis=0)
        axes.plot(shared / 1e6, median, color=colour, linewidth=2.2)
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    _legend(axes, {label: style.series_colour(index) for index, label in enumerate(groups)})
    style.label(axes, x="transitions (millions)", y=name)
    return figure


def agreement(groups: Mapping[str, Array], x: str, y: str) -> Figure:
    """Draw one measure of each agent over another; `groups` maps a label to pairs [2, agents].

    More than MOST_LINES groups have one colour and no legend.
    """
    figure = style.new_figure(height=HEIGHT + 0.2 + _legend_height(groups), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    for index, (first, second) in enumerate(groups.values()):
        colour = style.series_colour(index if len(groups) <= MOST_LINES else 0)
        axes.plot(first, second, "o", color=colour, alpha=0.7, markersize=DOT + 1.5, mew=0)
    everything = np.concatenate(list(groups.values()), axis=1)
    ends = [min(0.0, float(everything.min())), float(everything.max())]
    axes.plot(ends, ends, color=style.MUTED, linewidth=1, linestyle=(0, (3, 3)), zorder=1)
    if rho := rank_correlation(*everything):
        text = f"rank correlation {rho.value:.2f}"
        text += "" if rho.low is None else f" ({rho.low:.2f} to {rho.high:.2f})"
        axes.set_title(text, loc="left", fontsize=style.SMALL_SIZE, color=style.INK)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    _legend(axes, {name: style.series_colour(index) for index, name in enumerate(groups)})
    style.label(axes, x=x, y=y)
    return figure


def _draw_row(axes: Axes, height: float, values: Array, colour: str) -> None:
    """Draw one row: dots above the line, interval and interquartile mean below it."""
    if not values.size:
        axes.text(
            0.01,
            height,
            "no agent",
            transform=axes.get_yaxis_transform(),
            fontsize=style.SMALL_SIZE,
            color=style.MUTED,
            va="center",
            style="italic",
        )
        return
    places = height - 0.2 + JITTER * (np.arange(values.size) % 3 - 1)
    axes.plot(values, places, "o", color=colour, alpha=0.5, markersize=DOT, markeredgewidth=0)
    found = estimate(values)
    if found.low is not None and found.high is not None:
        axes.plot(
            [found.low, found.high], [height + 0.2] * 2, color=colour, linewidth=2.5, solid_capstyle="butt"
        )
    axes.plot(found.value, height + 0.2, "D", color=colour, markersize=MEAN - 1, markeredgewidth=0)


def _vertical_guide(axes: Axes, value: float, text: str) -> None:
    axes.axvline(value, color=style.MUTED, linewidth=1, linestyle=(0, (3, 3)), zorder=1)
    axes.annotate(
        text,
        xy=(value, 1),
        xycoords=("data", "axes fraction"),
        xytext=(3, -3),
        va="top",
        textcoords="offset points",
        fontsize=style.SMALL_SIZE,
        color=style.MUTED,
    )


def _legend_height(names: Collection[str]) -> float:
    """Return the height of a legend, inches."""
    return 0.17 * len(names) if 1 < len(names) <= MOST_LINES else 0.0


def _legend(axes: Axes, colours: Mapping[str, str]) -> None:
    """Name the colours above the panel, one below the other; nothing for one colour or too many."""
    if not _legend_height(colours):
        return
    handles = [axes.plot([], [], "s", color=colour, markersize=6)[0] for colour in colours.values()]
    axes.figure.legend(
        handles,
        [*map(cut, colours)],
        loc="outside upper left",
        fontsize=style.SMALL_SIZE,
        frameon=False,
        labelcolor=style.INK,
        handletextpad=0.3,
        borderpad=0,
        labelspacing=0.25,
    )


def described(groups: Mapping[str, Mapping[str, Array]], measure: str) -> str:
    """Return the alt text of `dot_rows`: the interquartile mean of every row, in words."""
    rows = [
        f"{label}{f', {name}' if name else ''}: {number_text(float(interquartile_mean(values)))}"
        if values.size
        else f"{label}: no agent"
        for label, group in groups.items()
        for name, values in group.items()
    ]
    return f"{measure} of every agent, with interquartile means. {'; '.join(rows)}."
