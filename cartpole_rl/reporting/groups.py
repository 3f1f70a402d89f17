"""Figures of groups of agents: every agent as a dot, and the interquartile mean with its 95 % interval.

They are narrow, so that their text can be read on a phone; headings are those of the page.
"""

import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cartpole_rl.drawing.colours import FAINT, INK, MUTED
from cartpole_rl.reporting import style
from cartpole_rl.reporting.results import (
    OWN,
    Named,
    Results,
    low_is_good,
    measure_label,
    sentence_start,
    value_text,
)
from cartpole_rl.reporting.statistics import Array, estimate, interquartile_mean, performance_profile

WIDTH, HEIGHT = 4.6, 2.9  # inch, of a figure and of a panel of curves
LINE = 0.21  # inch, of a row of dots and of a label
MOST_LINES = 8  # in a figure of curves
MOST_ROWS = 40  # groups in a figure of dots
MOST_GREY = 40  # grey lines in a figure of curves
MOST_DOTS = 200  # in a row
MOST_CURVES = 30  # thin lines of a group
MIDDLE = (10, 90)  # percentiles of the band that stands for more curves
PROFILE_POINTS = 101
FEWEST_PROFILED = 3  # agents
FEWEST_BANDED = 10  # agents: the interval of fewer covers the panel
DOT, MEAN = 4.0, 7.0  # points
NARROWEST = 1e-2  # width of an axis of dots, of the largest value: equal values can differ by rounding
JITTER = 0.16  # of a row
LONGEST_LABEL = 48  # characters
LONGEST_LINE = {"x": 42, "y": 30}  # characters of a line of an axis's label
UNEQUAL = 2.0  # ratio of two trainings' lengths from which their axis is the share of the training
DASHES = (0, (3, 3))
LOSS = "loss"  # name of a curve; the others are named by the measure of an evaluation

Curve = Sequence[tuple[float, float]]
Groups = Mapping[str, Mapping[str, Array]]  # label of a group: label of an evaluation: values [agents]
Content = TypeVar("Content")


@dataclass(frozen=True)
class Drawing:
    """A figure for the page; `alt` describes it for readers who cannot see it. `answer` stands above it."""

    name: str
    figure: Figure
    alt: str
    caption: str
    answer: str = ""


def drawings(results: Results) -> Iterator[Drawing]:
    """Yield the figures of groups that have agents."""
    if results.agents:
        yield dots(results)
        yield from profiles(results)
        yield from trainings(results)


def dots(results: Results) -> Drawing:
    """Return the figure of every agent as a dot."""
    measure, single = results.measure, len(results.evaluations) == 1
    groups = {
        group.label: {
            "" if single else each.label: results.values(group.name, each.name)
            for each in results.evaluations
        }
        for group in results.groups
    }
    shown, note = most(groups)
    good, label = results.good, measure_label(measure)
    values = [value for agent in results.agents for value in agent.values.values()]
    guided = good is not None and min(values) < good < max(values)
    figure = dot_rows(shown, label, {f"good: {good:g}": good} if good and guided else {})
    better = " Lower is better." if low_is_good(measure) else ""
    alt = described(shown, label, partial(value_text, measure=measure), results.unit)
    fullest = max(values.size for group in shown.values() for values in group.values())
    note += f" A row has at most {MOST_DOTS} dots, evenly chosen by rank." if fullest > MOST_DOTS else ""
    return Drawing("agents", figure, alt, f"{key(results.unit)}{better}{note}")


def key(unit: str) -> str:
    """Return what the marks of `dot_rows` are."""
    return f"Dots: {unit}s. Diamond and line: interquartile mean and its 95 % interval."


def most(groups: Groups) -> tuple[Groups, str]:
    """Return at most MOST_ROWS groups, the highest and the lowest, and a note if some are left out."""
    if len(groups) <= MOST_ROWS:
        return groups, ""
    ordered = ranked(groups)
    shown = [*ordered[: MOST_ROWS // 2], *ordered[-MOST_ROWS // 2 :]]
    note = f" Of {len(groups)} groups the {MOST_ROWS // 2} highest and the {MOST_ROWS // 2} lowest are drawn."
    return {label: groups[label] for label in shown}, note


def ranked(groups: Groups) -> list[str]:
    """Return the labels, highest interquartile mean of the last series first."""

    def height(label: str) -> float:
        last = [*groups[label].values()][-1]
        return float(interquartile_mean(last)) if last.size else float("-inf")

    return sorted(groups, key=height, reverse=True)


def described(groups: Groups, measure: str, number: Callable[[float], str], unit: str) -> str:
    """Return the alt text of `dot_rows`: the interquartile mean of every row, written by `number`."""
    rows = [
        f"{label}{f', {name}' if name else ''}: {number(float(interquartile_mean(values)))}"
        if values.size
        else f"{label}: no agent"
        for label, group in groups.items()
        for name, values in group.items()
    ]
    return f"{measure} of every {unit}, with interquartile means. {'; '.join(rows)}."


def group_colours(results: Results) -> dict[str, str]:
    """Return the colour of each group's label in all figures whose lines are groups."""
    groups = _in_evaluation(results, results.judged[0])
    return palette([*groups], [label for label in ranked(groups) if groups[label][""].size])


def _in_evaluation(results: Results, evaluation: Named) -> Groups:
    return {each.label: {"": results.values(each.name, evaluation.name)} for each in results.groups}


def _grey(colours: Mapping[str, str], what: str = "lines") -> str:
    """Return a note about set-ups that are too many to be told apart by colours."""
    if len(colours) <= MOST_LINES:
        return ""
    others = (
        "the others" if len(colours) <= MOST_GREY else f"at most {MOST_GREY} of the {len(colours) - 2} others"
    )
    return f" The set-ups with the highest and the lowest mean are coloured; the grey {what} are {others}."


def _drawn(labels: Sequence[str], colours: Mapping[str, str]) -> list[str]:
    """Return the labels whose lines are drawn: those with a colour, and MOST_GREY of the others."""
    grey = [label for label in labels if colours[label] == MUTED]
    kept = {*evenly(grey, MOST_GREY)}
    return [label for label in labels if colours[label] != MUTED or label in kept]


def evenly(items: Sequence[Content], most: int) -> list[Content]:
    """Return at most `most` items, evenly chosen, the first and the last among them."""
    if len(items) <= most:
        return [*items]
    return [items[place] for place in np.linspace(0, len(items) - 1, most).round().astype(int)]


def profiles(results: Results) -> Iterator[Drawing]:
    """Yield the performance profiles of the evaluations that count; none where lower is better."""
    if low_is_good(results.measure):
        return
    colours, label, unit = group_colours(results), measure_label(results.measure), results.unit
    for last in results.judged:
        groups = _in_evaluation(results, last)
        named = [label for label in ranked(groups) if groups[label][""].size >= FEWEST_PROFILED]
        names = {*_drawn(named, colours)}
        if not names:
            continue
        chosen = {name: groups[name][""] for name in groups if name in names}
        medians = "; ".join(
            f"{name}: half of the {unit}s above {np.median(each):.4g}" for name, each in chosen.items()
        )
        place = "" if last is OWN else f", {last.label}"
        yield Drawing(
            f"profiles_{last.name}" if len(results.judged) > 1 else "profiles",
            profile_curves(chosen, label, colours, unit),
            f"Performance profiles of {label}{place}. {medians}.",
            f"Performance profile{place}: the share of {unit}s above each value; further right "
            f"is better.{_grey(colours)}",
        )


def trainings(results: Results) -> Iterator[Drawing]:
    """Yield a figure of each curve of the trainings."""
    for name in dict.fromkeys(name for agent in results.agents for name in agent.curves):
        found = {
            group.label: [agent.curves[name] for agent in results.members(group.name) if name in agent.curves]
            for group in results.groups
        }
        colours = group_colours(results)
        drawn = _drawn([label for label, curves in found.items() if curves], colours)
        groups = {label: found[label] for label in drawn}
        ends = "; ".join(
            f"{label}: median {np.median([curve[-1][1] for curve in curves]):.3g} at the end"
            for label, curves in groups.items()
        )
        what = name if name == LOSS else f"{measure_label(name)} of an evaluation"
        axis = training_axis([max(curve[-1][0] for curve in curves) for curves in groups.values()])
        yield Drawing(
            f"training_{name}",
            training_curves(groups, what, colours),
            f"{sentence_start(what)} over the {axis}. {ends}.",
            f"Training: {what}. {_spread_key(groups)} Thick line: their median.{_grey(colours, 'medians')}",
        )


def _spread_key(groups: Mapping[str, Sequence[Curve]]) -> str:
    """Return what shows the agents of a group beside their median."""
    lines = "Thin lines: agents."
    crowded = any(len(curves) > MOST_CURVES for curves in groups.values())
    return f"{lines} Of more than {MOST_CURVES}, a band: their middle 80 %." if crowded else lines


def cut(label: str) -> str:
    """Return a label that fits into a figure; the page's tables have the whole one."""
    return label if len(label) <= LONGEST_LABEL else label[: LONGEST_LABEL - 1].rstrip() + "…"


def palette(labels: Sequence[str], ranked: Sequence[str] = ()) -> dict[str, str]:
    """Return the colour of each set-up of a page's section, the same in all of its figures.

    Of more than MOST_LINES only the first and the last of `ranked` have a colour; the others are grey.
    """
    if len(labels) <= MOST_LINES:
        return {label: style.series_colour(index) for index, label in enumerate(labels)}
    ends = [*ranked[:1], *ranked[1:][-1:]]
    return dict.fromkeys(labels, MUTED) | dict(zip(ends, style.SERIES, strict=False))


def series_colours(names: Sequence[str]) -> dict[str, str]:
    """Return the colours of evaluations: others than the first of `palette`."""
    return {name: style.series_colour(-1 - index) for index, name in enumerate(names)}


def panel(names: Collection[str], height: float = HEIGHT, grid: str = "both") -> tuple[Figure, Axes]:
    """Return a figure with one panel, and room for a legend of `names`."""
    figure = style.new_figure(height=height + _legend_height(names), width=WIDTH)
    axes = figure.subplots()
    style.dress(axes, grid=grid)
    return figure, axes


def finish(axes: Axes, colours: Mapping[str, str], x: str, y: str | None = None) -> None:
    """Name the colours above the panel, and label the axes in lines that fit beside them."""
    _legend(axes, colours)
    sides = (("x", x), ("y", y))
    lines = (style.plain(textwrap.fill(text, LONGEST_LINE[side])) if text else None for side, text in sides)
    style.label(axes, *lines)


def dot_rows(groups: Groups, measure: str, guides: Mapping[str, float]) -> Figure:
    """Draw the values of each group's series as a row of dots, with interquartile mean and interval.

    A series has one colour throughout, another one than set-ups have in other figures; rows of a single
    series have the colours of their set-ups. `guides` names values of `measure` to draw as vertical lines.
    """
    series = list(dict.fromkeys(name for group in groups.values() for name in group))
    colours = series_colours(series)
    of_groups = palette([*groups]) if len(series) == 1 and len(groups) <= MOST_LINES else {}
    lines = len(groups) + sum(len(group) for group in groups.values())
    figure, axes = panel(series, LINE * (lines + 1) + 0.5, grid="x")
    axes.spines["left"].set_visible(False)
    height = 0.0
    for label, group in groups.items():
        axes.axhspan(height - 0.44, height + 0.44, facecolor=FAINT, edgecolor="none", zorder=1.5)
        _row_text(axes, 0.005, height, style.plain(cut(label)), color=INK, fontweight="bold")
        for name, values in group.items():
            height += 1
            _draw_row(axes, height, values, of_groups.get(label, colours[name]))
        height += 1
    for name, value in guides.items():
        axes.axvline(value, color=MUTED, linewidth=1, linestyle=DASHES, zorder=1)
        of = "data", "axes fraction"
        style.note(axes, name, (value, 1), of, (0, 2), MUTED, ha="center", va="bottom")
    low, high = axes.get_xlim()
    if (lacking := NARROWEST * max(abs(low), abs(high)) - (high - low)) > 0:
        axes.set_xlim(low - lacking / 2, high + lacking / 2)
    axes.set_ylim(height - 0.4, -0.5)
    axes.set_yticks([])
    finish(axes, colours, x=measure)
    return figure


def _row_text(axes: Axes, place: float, height: float, text: str, **looks: Any) -> None:
    transform = axes.get_yaxis_transform()
    axes.text(place, height, text, transform=transform, fontsize=style.SMALL_SIZE, va="center", **looks)


def _draw_row(axes: Axes, height: float, values: Array, colour: str) -> None:
    """Draw one row: dots above the line, interval and interquartile mean below it."""
    if not values.size:
        _row_text(axes, 0.01, height, "no agent", color=MUTED, style="italic")
        return
    dots = values if values.size <= MOST_DOTS else np.array(evenly(sorted(values), MOST_DOTS))
    places = height - 0.2 + JITTER * (np.arange(dots.size) % 3 - 1)
    axes.plot(dots, places, "o", color=colour, alpha=0.5, markersize=DOT, markeredgewidth=0)
    found, middle = estimate(values), height + 0.2
    if found.low is not None and found.high is not None:
        ends = [found.low, found.high]
        axes.plot(ends, [middle] * 2, color=colour, linewidth=2.5, solid_capstyle="butt")
    axes.plot(found.value, middle, "D", color=colour, markersize=MEAN - 1, markeredgewidth=0)


def profile_curves(
    groups: Mapping[str, Array], measure: str, colours: Mapping[str, str], unit: str
) -> Figure:
    """Draw the share of each group's agents [agents] above every score, of many agents with its 95 % band.

    Groups whose colour is grey have thin lines without a band. `unit` is what an agent is called.
    """
    named = _named(groups, colours)
    figure, axes = panel(named)
    everything = np.concatenate(list(groups.values()))
    low, high = float(everything.min()), float(everything.max())
    margin = 0.05 * max(high - low, NARROWEST * max(abs(low), abs(high))) or 1.0
    scores = np.linspace(low - margin, high + margin, PROFILE_POINTS)
    for label, values in _grey_first(groups, colours):
        share, lower, upper = performance_profile(values, scores)
        axes.plot(scores, share, color=colours[label], linewidth=2 if label in named else 0.8)
        if label in named and values.size >= FEWEST_BANDED:
            axes.fill_between(scores, lower, upper, color=colours[label], alpha=0.15, linewidth=0)
    axes.set_ylim(-0.02, 1.04)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    finish(axes, named, x=measure, y=f"share of {unit}s above")
    return figure


def training_curves(groups: Mapping[str, Sequence[Curve]], name: str, colours: Mapping[str, str]) -> Figure:
    """Draw a curve of each agent over its training as a thin line, and a group's median as a thick one.

    A group of more than MOST_CURVES has a band instead of the thin lines. Groups whose colour is grey have a
    thin median alone. Where trainings differ in length by more than UNEQUAL, the axis is the share of the
    training.
    """
    named = _named(groups, colours)
    figure, axes = panel(named)
    lengths = {label: max(curve[-1][0] for curve in curves) for label, curves in groups.items()}
    share = max(lengths.values()) > UNEQUAL * min(lengths.values())
    for label, curves in _grey_first(groups, colours):
        scale = lengths[label] if share else 1e6
        points = [np.array(curve).T / np.array([[scale], [1.0]]) for curve in curves]
        _draw_curves(axes, points, colours[label], label in named)
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    finish(axes, named, x=training_axis([*lengths.values()]), y=name)
    return figure


def _draw_curves(axes: Axes, curves: Sequence[Array], colour: str, named: bool) -> None:
    """Draw the curves [2, points] of one group and their median; of a group that is not named the median."""
    shared = curves[0][0][curves[0][0] <= min(each[0][-1] for each in curves)]
    values = np.array([np.interp(shared, *each) for each in curves])
    if named and len(curves) > MOST_CURVES:
        low, high = np.percentile(values, MIDDLE, axis=0)
        axes.fill_between(shared, low, high, color=colour, alpha=0.2, linewidth=0)
    elif named:
        for places, own in curves:
            axes.plot(places, own, color=colour, alpha=0.45, linewidth=0.8)
    axes.plot(shared, np.median(values, axis=0), color=colour, linewidth=2.2 if named else 0.8)


def training_axis(lengths: Sequence[float]) -> str:
    """Return what the axis of trainings of these lengths (transitions) shows."""
    shortest, longest = (f"{end(lengths) / 1e6:.2g}" for end in (min, max))
    if max(lengths) <= UNEQUAL * min(lengths):
        return "transitions (millions)"
    return f"share of the training ({shortest} to {longest} million transitions)"


def _named(groups: Collection[str], colours: Mapping[str, str]) -> dict[str, str]:
    """Return the groups that have a colour, which the legend names."""
    return {label: colours[label] for label in groups if colours[label] != MUTED}


def _grey_first(groups: Mapping[str, Content], colours: Mapping[str, str]) -> Iterator[tuple[str, Content]]:
    """Yield the groups without a colour, then those over them."""
    yield from sorted(groups.items(), key=lambda item: colours[item[0]] != MUTED)


def _legend_height(names: Collection[str]) -> float:
    """Return the height of a legend, inches."""
    return 0.17 * len(names) if 1 < len(names) <= MOST_LINES else 0.0


def _legend(axes: Axes, colours: Mapping[str, str]) -> None:
    """Name the colours above the panel, one below the other; nothing for one colour or too many."""
    if not _legend_height(colours):
        return
    axes.figure.legend(
        [axes.plot([], [], "s", color=colour, markersize=6)[0] for colour in colours.values()],
        [style.plain(cut(label)) for label in colours],
        loc="outside upper left",
        fontsize=style.SMALL_SIZE,
        frameon=False,
        labelcolor=INK,
        handletextpad=0.3,
        borderpad=0,
        labelspacing=0.25,
    )
