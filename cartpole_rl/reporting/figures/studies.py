"""Figures of studies: every agent as a dot, and the interquartile mean with its 95 % interval.

They are narrow, so that their text can be read on a phone; headings are those of the page.
"""

import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures.annotations import plain
from cartpole_rl.reporting.studies.statistics import (
    estimate,
    interquartile_mean,
    performance_profile,
    rank_correlation,
)

WIDTH = 4.6  # inch
LINE = 0.21  # inch, of a row of dots and of a label
MOST_LINES = 8  # in a figure of curves
PROFILE_POINTS = 101
DOT, MEAN = 4.0, 7.0  # points
JITTER = 0.16  # of a row
HEIGHT = 2.9  # inch, of a panel of curves
LONGEST_LABEL = 48  # characters
LONGEST_LINE = {"x": 42, "y": 30}  # characters of a line of an axis's label
CHARACTER = 0.022  # of the width of a panel, in the label of a tick
UNEQUAL = 2.0  # ratio of two trainings' lengths from which their axis is the share of the training

Array = NDArray[np.float64]
Curve = Sequence[tuple[float, float]]
Content = TypeVar("Content")


def cut(label: str) -> str:
    """Return a label that fits into a figure; the page's tables have the whole one."""
    return label if len(label) <= LONGEST_LABEL else label[: LONGEST_LABEL - 1].rstrip() + "…"


def palette(labels: Sequence[str], ranked: Sequence[str] = ()) -> dict[str, str]:
    """Return the colour of each set-up of a study, the same in all of its figures.

    Of more than MOST_LINES only the first and the last of `ranked` have a colour; the others are grey.
    """
    if len(labels) <= MOST_LINES:
        return {label: style.series_colour(index) for index, label in enumerate(labels)}
    ends = [*ranked[:1], *ranked[1:][-1:]]
    return dict.fromkeys(labels, style.MUTED) | dict(zip(ends, style.SERIES, strict=False))


def series_colours(names: Sequence[str]) -> dict[str, str]:
    """Return the colours of a study's evaluations: others than the first of `palette`."""
    return {name: style.series_colour(-1 - index) for index, name in enumerate(names)}


def dot_rows(
    groups: Mapping[str, Mapping[str, Array]], measure: str, guides: Mapping[str, float] | None = None
) -> Figure:
    """Draw the values of each group's series as a row of dots, with interquartile mean and interval.

    `groups` maps a label to its series, each an array [agents]. A series has one colour throughout, another
    one than set-ups have in other figures; rows of a single series have the colours of their set-ups.
    `guides` names values of `measure` to draw as vertical lines.
    """
    series = list(dict.fromkeys(name for group in groups.values() for name in group))
    colours = series_colours(series)
    of_groups = palette([*groups]) if len(series) == 1 and len(groups) <= MOST_LINES else {}
    lines = len(groups) + sum(len(group) for group in groups.values())
    figure = style.new_figure(height=LINE * (lines + 1) + 0.5 + _legend_height(series), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes, grid="x")
    axes.spines["left"].set_visible(False)
    height = 0.0
    for label, group in groups.items():
        _draw_heading(axes, height, label)
        for name, values in group.items():
            height += 1
            _draw_row(axes, height, values, of_groups.get(label, colours[name]))
        height += 1
    for name, value in (guides or {}).items():
        _vertical_guide(axes, value, name)
    axes.set_ylim(height - 0.4, -0.5)
    axes.set_yticks([])
    _legend(axes, colours)
    _label(axes, x=measure)
    return figure


def curves_over_axis(
    lines: Mapping[str, tuple[Sequence[float], Sequence[Array]]],
    axis: str,
    measure: str,
    colours: Mapping[str, str],
) -> Figure:
    """Draw the interquartile mean over a quantity, with its interval as a band, and every agent as a dot.

    `lines` maps a label to the places [S] on the axis and the values there, S arrays [agents].
    """
    figure = style.new_figure(height=HEIGHT + _legend_height(lines), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    for label, (places, values) in lines.items():
        colour = colours[label]
        found = [estimate(each) for each in values]
        axes.plot(places, [each.value for each in found], color=colour, linewidth=2, marker="o", markersize=5)
        if all(each.low is not None for each in found):
            low, high = ([getattr(each, end) for each in found] for end in ("low", "high"))
            axes.fill_between(places, low, high, color=colour, alpha=0.2, linewidth=0)
        for place, each in zip(places, values, strict=True):
            axes.plot(np.full(each.size, place), each, "o", color=colour, alpha=0.45, markersize=3, mew=0)
    _tick_at(axes, sorted({place for places, _ in lines.values() for place in places}))
    _legend(axes, {label: colours[label] for label in lines})
    _label(axes, x=axis, y=measure)
    return figure


def profiles(groups: Mapping[str, Array], measure: str, colours: Mapping[str, str], unit: str) -> Figure:
    """Draw the share of each group's agents [agents] above every score, with its 95 % band.

    Groups whose colour is grey have thin lines without a band. `unit` is what an agent is called.
    """
    named = _named(groups, colours)
    figure = style.new_figure(height=HEIGHT + _legend_height(named), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    everything = np.concatenate(list(groups.values()))
    low, high = float(everything.min()), float(everything.max())
    margin = 0.05 * (high - low or 1.0)
    scores = np.linspace(low - margin, high + margin, PROFILE_POINTS)
    for label, values in _grey_first(groups, colours):
        share, lower, upper = performance_profile(values, scores)
        axes.plot(scores, share, color=colours[label], linewidth=2 if label in named else 0.8)
        if label in named and values.size > 1:
            axes.fill_between(scores, lower, upper, color=colours[label], alpha=0.15, linewidth=0)
    axes.set_ylim(-0.02, 1.04)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    _legend(axes, named)
    _label(axes, x=measure, y=f"share of {unit}s above")
    return figure


def training_curves(groups: Mapping[str, Sequence[Curve]], name: str, colours: Mapping[str, str]) -> Figure:
    """Draw a curve of each agent over its training as a thin line, and a group's median as a thick one.

    Groups whose colour is grey have a thin median alone. Where trainings differ in length by more than
    UNEQUAL, the axis is the share of the training.
    """
    named = _named(groups, colours)
    figure = style.new_figure(height=HEIGHT + _legend_height(named), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    lengths = {label: max(curve[-1][0] for curve in curves) for label, curves in groups.items()}
    share = max(lengths.values()) > UNEQUAL * min(lengths.values())
    for label, curves in _grey_first(groups, colours):
        colour, scale = colours[label], lengths[label] if share else 1e6
        points = [np.array(curve, dtype=float).T for curve in curves]
        for transitions, values in points if label in named else ():
            axes.plot(transitions / scale, values, color=colour, alpha=0.45, linewidth=0.8)
        shared = points[0][0][points[0][0] <= min(each[0][-1] for each in points)]
        median = np.median([np.interp(shared, *each) for each in points], axis=0)
        axes.plot(shared / scale, median, color=colour, linewidth=2.2 if label in named else 0.8)
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    _legend(axes, named)
    _label(axes, x=training_axis([*lengths.values()]), y=name)
    return figure


def training_axis(lengths: Sequence[float]) -> str:
    """Return what the axis of trainings of these lengths (transitions) shows."""
    shortest, longest = (f"{end(lengths) / 1e6:.2g}" for end in (min, max))
    if max(lengths) <= UNEQUAL * min(lengths):
        return "transitions (millions)"
    return f"share of the training ({shortest} to {longest} million transitions)"


def agreement(
    groups: Mapping[str, Array], x: str, y: str, colours: Mapping[str, str] | None = None
) -> Figure:
    """Draw one measure of each agent over another; `groups` maps a label to pairs [2, agents].

    More than MOST_LINES groups have one colour and no legend. The axes start at 0, or at the lowest value if
    all lie in the upper half.
    """
    figure = style.new_figure(height=HEIGHT + 0.2 + _legend_height(groups), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes)
    several = len(groups) <= MOST_LINES
    shown = (colours or palette([*groups])) if several else dict.fromkeys(groups, style.SERIES[0])
    for label, (first, second) in groups.items():
        axes.plot(first, second, "o", color=shown[label], alpha=0.7, markersize=DOT + 1.5, mew=0)
    everything = np.concatenate(list(groups.values()), axis=1)
    low, high = float(everything.min()), float(everything.max())
    ends = [low if low > high / 2 else min(0.0, low), high]
    axes.plot(ends, ends, color=style.MUTED, linewidth=1, linestyle=(0, (3, 3)), zorder=1)
    if rho := rank_correlation(*everything):
        text = f"rank correlation {rho.value:.2f}"
        text += "" if rho.low is None else f" ({rho.low:.2f} to {rho.high:.2f})"
        axes.set_title(text, loc="left", fontsize=style.SMALL_SIZE, color=style.INK)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    _legend(axes, {label: shown[label] for label in groups})
    _label(axes, x=x, y=y)
    return figure


def _named(groups: Collection[str], colours: Mapping[str, str]) -> dict[str, str]:
    """Return the groups that have a colour, which the legend names."""
    return {label: colours[label] for label in groups if colours[label] != style.MUTED}


def _grey_first(groups: Mapping[str, Content], colours: Mapping[str, str]) -> Iterator[tuple[str, Content]]:
    """Yield the groups without a colour, then those over them."""
    yield from sorted(groups.items(), key=lambda item: colours[item[0]] != style.MUTED)


def _label(axes: Axes, x: str, y: str | None = None) -> None:
    """Label the axes in lines that fit beside them."""
    sides = (("x", x), ("y", y))
    lines = (plain(textwrap.fill(text, LONGEST_LINE[side])) if text else None for side, text in sides)
    style.label(axes, *lines)


def _tick_at(axes: Axes, places: Sequence[float]) -> None:
    """Set a tick at each place, and a label where it does not run into the one before."""
    span = (places[-1] - places[0]) or 1.0
    labelled: list[float] = []
    for place in places:
        room = CHARACTER * (len(f"{place:g}") + 1) * span
        if not labelled or place - labelled[-1] >= room:
            labelled.append(place)
    axes.set_xticks(labelled, [f"{place:g}" for place in labelled])
    axes.set_xticks(places, minor=True)
    axes.tick_params(axis="x", which="minor", color=style.MUTED, length=3.5)


def _draw_heading(axes: Axes, height: float, label: str) -> None:
    """Write the label of a group on a band of its own, over the grid."""
    axes.axhspan(height - 0.44, height + 0.44, facecolor=style.FAINT, edgecolor="none", zorder=1.5)
    axes.text(
        0.005,
        height,
        plain(cut(label)),
        transform=axes.get_yaxis_transform(),
        fontsize=style.SMALL_SIZE,
        color=style.INK,
        va="center",
        fontweight="bold",
    )


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
    """Draw a dashed line, with its text over the panel."""
    axes.axvline(value, color=style.MUTED, linewidth=1, linestyle=(0, (3, 3)), zorder=1)
    axes.annotate(
        text,
        xy=(value, 1),
        xycoords=("data", "axes fraction"),
        xytext=(0, 2),
        ha="center",
        va="bottom",
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
        [plain(cut(label)) for label in colours],
        loc="outside upper left",
        fontsize=style.SMALL_SIZE,
        frameon=False,
        labelcolor=style.INK,
        handletextpad=0.3,
        borderpad=0,
        labelspacing=0.25,
    )


def described(
    groups: Mapping[str, Mapping[str, Array]], measure: str, number: Callable[[float], str], unit: str
) -> str:
    """Return the alt text of `dot_rows`: the interquartile mean of every row, in words.

    `number` writes a value.
    """
    rows = [
        f"{label}{f', {name}' if name else ''}: {number(float(interquartile_mean(values)))}"
        if values.size
        else f"{label}: no agent"
        for label, group in groups.items()
        for name, values in group.items()
    ]
    return f"{measure} of every {unit}, with interquartile means. {'; '.join(rows)}."
