"""The figures of a study as SVG with alt texts and captions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures.studies import (
    MOST_LINES,
    agreement,
    curves_over_axis,
    described,
    dot_rows,
    palette,
    profiles,
    series_colours,
    training_axis,
    training_curves,
)
from cartpole_rl.reporting.studies.answers import GOOD
from cartpole_rl.reporting.studies.numbers import (
    counted_text,
    estimate_text,
    low_is_good,
    measure_label,
    percent,
    sentence_start,
    value_text,
)
from cartpole_rl.reporting.studies.results import OWN, SMALLEST, StudyResults
from cartpole_rl.reporting.studies.settings import Variant
from cartpole_rl.reporting.studies.statistics import estimate, interquartile_mean
from cartpole_rl.reporting.table import number_text

MOST_ROWS = 40  # groups in a figure of dots
FEWEST_PROFILED = 3  # agents
LOSS = "loss"  # name of a curve; the others are named by the measure of an evaluation

Array = NDArray[np.float64]
Groups = Mapping[str, Mapping[str, Array]]


@dataclass(frozen=True)
class Drawing:
    """A figure for the page; `alt` describes it for readers who cannot see it. `answer` stands above it."""

    name: str
    figure: Figure
    alt: str
    caption: str
    answer: str = ""


def drawings(results: StudyResults) -> Iterator[Drawing]:
    """Yield the figures of a study that has agents."""
    if not results.agents:
        return
    yield _over_axis(results) if results.varied else _dots(results)
    if results.study.ratio:
        yield from _ratios(results)
    if not results.varied and not low_is_good(results.study.measure):
        yield from _profiles(results)
    for name in dict.fromkeys(name for agent in results.agents for name in agent.curves):
        yield from _training(results, name)
    if len(results.evaluations) > 1 and not results.varied:
        yield from _agreement(results)


def _groups(results: StudyResults) -> dict[str, dict[str, Array]]:
    """Return the values of each arm's evaluations by their labels."""
    evaluations = results.evaluations
    single = len(evaluations) == 1
    return {
        arm.label: {"" if single else each.label: results.values(arm.name, each.name) for each in evaluations}
        for arm in results.study.arms
    }


def _dots(results: StudyResults) -> Drawing:
    groups, note = _most(_groups(results))
    label = measure_label(results.study.measure)
    good = GOOD.get(results.study.measure)
    values = [value for agent in results.agents for value in agent.values.values()]
    guided = good is not None and min(values) < good < max(values)
    figure = dot_rows(groups, label, {f"good: {good:g}": good} if good and guided else None)
    better = " Lower is better." if low_is_good(results.study.measure) else ""
    alt = described(groups, label, partial(value_text, measure=results.study.measure), results.study.unit)
    return Drawing("agents", figure, alt, f"{_key(results)}{better}{note}")


def _key(results: StudyResults) -> str:
    """Return what the marks of `dot_rows` are."""
    return f"Dots: {results.study.unit}s. Diamond and line: interquartile mean and its 95 % interval."


def _most(groups: Groups) -> tuple[Groups, str]:
    """Return at most MOST_ROWS groups, the highest and the lowest, and a note if some are left out."""
    if len(groups) <= MOST_ROWS:
        return groups, ""
    ranked = [*_ranked(groups)]
    shown = [*ranked[: MOST_ROWS // 2], *ranked[-MOST_ROWS // 2 :]]
    note = f" Of {len(groups)} groups the {MOST_ROWS // 2} highest and the {MOST_ROWS // 2} lowest are drawn."
    return {label: groups[label] for label in shown}, note


def _ranked(groups: Groups) -> list[str]:
    """Return the labels, highest interquartile mean of the last series first."""

    def height(label: str) -> float:
        last = [*groups[label].values()][-1]
        return float(interquartile_mean(last)) if last.size else float("-inf")

    return sorted(groups, key=height, reverse=True)


def _over_axis(results: StudyResults) -> Drawing:
    axis = results.study.axis
    assert axis
    lines = {
        name: ([value for value, _ in points], [values for _, values in points])
        for name, points in _lines(results).items()
        if points
    }
    label = measure_label(results.study.measure)
    quantity = f"{axis.label}, {axis.unit}" if axis.unit else axis.label
    ends = "; ".join(
        f"{name}: {estimate_text(estimate(values[0]), results.study.measure)} at {at[0]:g}, "
        f"{estimate_text(estimate(values[-1]), results.study.measure)} at {at[-1]:g}"
        for name, (at, values) in lines.items()
    )
    caption = f"Dots: {results.study.unit}s. Line and band: interquartile mean and its 95 % interval."
    figure = curves_over_axis(lines, quantity, label, _line_colours(results, [*lines]))
    return Drawing("agents", figure, f"{label} over {quantity}. {ends}.", caption)


def _line_colours(results: StudyResults, lines: Sequence[str]) -> dict[str, str]:
    """Return the colours of lines over an axis: those of their arms or evaluations, if they are such."""
    arms = _colours(results)
    if {*lines} <= arms.keys() and len(arms) <= MOST_LINES:
        return arms
    evaluations = [each.label for each in results.evaluations]
    if {*lines} <= {*evaluations}:
        return series_colours(evaluations)
    return {label: style.series_colour(index) for index, label in enumerate(lines)}


def _lines(results: StudyResults) -> dict[str, list[tuple[float, Array]]]:
    """Return the places and the values of each line: of an arm, or of an evaluation and a family of arms."""
    lines: dict[str, list[tuple[float, Array]]] = {}
    places = {each.name for each in results.varied}
    for arm in results.study.arms:
        for evaluation in results.evaluations:
            if evaluation.name in places:
                name, value = arm.label, evaluation.value
            elif arm.name in places:
                several = len(results.evaluations) > 1
                name, value = ", ".join((_family(arm), *([evaluation.label] if several else []))), arm.value
            else:
                continue
            values = results.values(arm.name, evaluation.name)
            if value is not None and values.size:
                lines.setdefault(name.strip(", "), []).append((value, values))
    return {name: sorted(points, key=lambda point: point[0]) for name, points in lines.items()}


def _family(arm: Variant) -> str:
    """Return the label without its last part, which is the value: "explicit" of "explicit, 20 ms"."""
    return arm.label.rpartition(",")[0]


def _ratios(results: StudyResults) -> Iterator[Drawing]:
    groups = {arm.label: {"": results.ratios(arm.name)} for arm in results.study.arms}
    if not any(series[""].size for series in groups.values()):
        return
    first, second = results.evaluations[:2]
    label = f"{second.label} / {first.label}"
    shown, note = _most(groups)
    counted = sum(series[""].size for series in groups.values())
    if failed := results.pairs(first.name, second.name).shape[1] - counted:
        least = f"{percent(SMALLEST)} of the highest on the {first.label}"
        note += f" {counted_text(failed)} without ratio: under {least}."
    figure = dot_rows(shown, label, {"1": 1.0})
    yield Drawing(
        "ratios",
        figure,
        described(shown, f"Ratio {label}", number_text, "agent"),
        f"Ratio: {second.label} divided by {first.label}, per agent. {_key(results)}{note}",
    )


def _profiles(results: StudyResults) -> Iterator[Drawing]:
    colours, label = _colours(results), measure_label(results.study.measure)
    for last in results.judged:
        groups = {arm.label: {"": results.values(arm.name, last.name)} for arm in results.study.arms}
        ranked = [label for label in _ranked(groups) if groups[label][""].size >= FEWEST_PROFILED]
        if not ranked:
            continue
        chosen = {name: series[""] for name, series in groups.items() if name in ranked}
        medians = "; ".join(
            f"{name}: half of the {results.study.unit}s above {np.median(each):.4g}"
            for name, each in chosen.items()
        )
        place = "" if last is OWN else f", {last.label}"
        yield Drawing(
            f"profiles_{last.name}" if len(results.judged) > 1 else "profiles",
            profiles(chosen, label, colours, results.study.unit),
            f"Performance profiles of {label}{place}. {medians}.",
            f"Performance profile{place}: the share of {results.study.unit}s above each value; further right "
            f"is better.{_grey(colours)}",
        )


def _colours(results: StudyResults) -> dict[str, str]:
    """Return the colour of each arm's label in all figures of a study whose lines are arms."""
    groups = {arm.label: {"": results.values(arm.name, results.judged[0].name)} for arm in results.study.arms}
    present = [label for label in _ranked(groups) if groups[label][""].size]
    return palette([*groups], present)


def _grey(colours: Mapping[str, str], what: str = "lines") -> str:
    """Return a note about set-ups that are too many to be told apart by colours."""
    if len(colours) <= MOST_LINES:
        return ""
    return f" The set-ups with the highest and the lowest mean are coloured; the grey {what} are the others."


def _training(results: StudyResults, name: str) -> Iterator[Drawing]:
    groups = {
        arm.label: [
            agent.curves[name] for agent in results.agents if agent.arm == arm.name and name in agent.curves
        ]
        for arm in results.study.arms
    }
    drawn = [label for label, curves in groups.items() if curves]
    if not drawn:
        return
    ends = "; ".join(
        f"{label}: median {np.median([curve[-1][1] for curve in groups[label]]):.3g} at the end"
        for label in drawn
    )
    what = name if name == LOSS else f"{measure_label(name)} of an evaluation"
    colours = _colours(results)
    figure = training_curves({label: groups[label] for label in drawn}, what, colours)
    axis = training_axis([max(curve[-1][0] for curve in groups[label]) for label in drawn])
    yield Drawing(
        f"training_{name}",
        figure,
        f"{sentence_start(what)} over the {axis}. {ends}.",
        f"Training: {what}. Thin lines: agents. Thick line: their median.{_grey(colours, 'medians')}",
    )


def _agreement(results: StudyResults) -> Iterator[Drawing]:
    first, second = results.evaluations[:2]
    pairs = {arm.label: results.pairs(first.name, second.name, arm.name) for arm in results.study.arms}
    present = {label: each for label, each in pairs.items() if each.size}
    if sum(each.shape[1] for each in present.values()) < FEWEST_PROFILED:
        return
    label = measure_label(results.study.measure)
    figure = agreement(present, f"{label}, {first.label}", f"{label}, {second.label}", _colours(results))
    yield Drawing(
        "agreement",
        figure,
        f"{sentence_start(label)} of each agent: {second.label} over {first.label}.",
        f"Each agent on both: a dot on the dashed line has the same {label} on both. "
        f"Rank correlation over {_together(present)}.{one_colour(present, 'set-ups')}",
    )


def _together(groups: Mapping[str, Array]) -> str:
    """Return whose rank correlation it is; differences between set-ups are part of it."""
    agents = counted_text(sum(each.shape[1] for each in groups.values()))
    return f"all {len(groups)} set-ups together, {agents}" if len(groups) > 1 else agents


def one_colour(groups: Mapping[str, Array], name: str) -> str:
    """Return a note about groups that are too many to be told apart by colours; `name` says what they are."""
    return f" Colours do not distinguish the {name}." if len(groups) > MOST_LINES else ""
