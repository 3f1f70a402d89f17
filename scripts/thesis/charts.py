"""The figures of studies beyond those of any report: over an axis, ratios, and simulation beside the cart."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike
from results import SMALLEST, StudyResults
from scipy import stats

from cartpole_rl.reporting import groups, style
from cartpole_rl.reporting.groups import DASHES, DOT, FEWEST_PROFILED, MOST_LINES, Drawing, finish, panel
from cartpole_rl.reporting.results import SCORES, Named, estimate_text, measure_label, sentence_start
from cartpole_rl.reporting.statistics import Array, Estimate, bootstrap, estimate
from cartpole_rl.reporting.texts import count_text, number_text

CHARACTER = 0.022  # of the width of a panel, in the label of a tick
FEWEST_RANKED = 4  # agents from which a rank correlation has an interval
CLEAR = 0.8  # rank correlation from which an order predicts the other well

Lines = Mapping[str, tuple[Sequence[float], Sequence[Array]]]  # label: places [S], S arrays [agents]


def drawings(results: StudyResults) -> Iterator[Drawing]:
    """Yield the figures of a study that has agents."""
    if not results.agents:
        return
    yield _over_axis(results) if results.varied else groups.dots(results)
    if results.study.ratio:
        yield from _ratios(results)
    if not results.varied:
        yield from groups.profiles(results)
    yield from groups.trainings(results)
    if len(results.evaluations) > 1 and not results.varied:
        yield from _agreement(results)


def _over_axis(results: StudyResults) -> Drawing:
    axis, measure, lines = results.study.axis, results.measure, _lines(results)
    assert axis
    label = measure_label(measure)
    quantity = f"{axis.label}, {axis.unit}" if axis.unit else axis.label
    ends = "; ".join(
        f"{name}: {estimate_text(estimate(values[0]), measure)} at {at[0]:g}, "
        f"{estimate_text(estimate(values[-1]), measure)} at {at[-1]:g}"
        for name, (at, values) in lines.items()
    )
    caption = f"Dots: {results.unit}s. Line and band: interquartile mean and its 95 % interval."
    figure = curves_over_axis(lines, quantity, label, _line_colours(results, [*lines]))
    return Drawing("agents", figure, f"{label} over {quantity}. {ends}.", caption)


def _lines(results: StudyResults) -> Lines:
    """Return the places and the values of each line: of an arm, or of an evaluation and a family of arms."""
    lines: dict[str, list[tuple[float, Array]]] = {}
    places = {each.name: each.value for each in results.varied if each.value is not None}
    several = len(results.evaluations) > 1
    for arm in results.groups:
        for evaluation in results.evaluations:
            if evaluation.name in places:
                name, place = arm.label, places[evaluation.name]
            elif arm.name in places:  # "explicit" of "explicit, 20 ms"
                family = arm.label.rpartition(",")[0]
                name, place = ", ".join((family, *([evaluation.label] if several else []))), places[arm.name]
            else:
                continue
            if (values := results.values(arm.name, evaluation.name)).size:
                lines.setdefault(name.strip(", "), []).append((place, values))
    found = {name: sorted(points, key=lambda point: point[0]) for name, points in lines.items()}
    return {name: ([x for x, _ in points], [y for _, y in points]) for name, points in found.items()}


def _line_colours(results: StudyResults, lines: Sequence[str]) -> dict[str, str]:
    """Return the colour of each line: that of an arm or an evaluation in all figures of the study."""
    arms, evaluations = [arm.label for arm in results.groups], [each.label for each in results.evaluations]
    if {*lines} <= {*arms} and len(arms) <= MOST_LINES:
        return groups.palette(arms)
    if {*lines} <= {*evaluations}:
        return groups.series_colours(evaluations)
    return {label: style.series_colour(index) for index, label in enumerate(lines)}


def _ratios(results: StudyResults) -> Iterator[Drawing]:
    found = {arm.label: {"": results.ratios(arm.name)} for arm in results.groups}
    counted = sum(series[""].size for series in found.values())
    if not counted:
        return
    first, second = results.evaluations[:2]
    label = f"{second.label} / {first.label}"
    shown, note = groups.most(found)
    if failed := results.pairs(first.name, second.name).shape[1] - counted:
        least = f"{100 * SMALLEST:.0f} % of the highest on the {first.label}"
        note += f" {count_text(failed, 'agent')} without ratio: under {least}."
    yield Drawing(
        "ratios",
        groups.dot_rows(shown, label, {"1": 1.0}),
        groups.described(shown, f"Ratio {label}", number_text, "agent"),
        f"Ratio: {second.label} divided by {first.label}, per agent. {groups.key(results.unit)}{note}",
    )


def _agreement(results: StudyResults) -> Iterator[Drawing]:
    first, second = results.evaluations[:2]
    pairs = {arm.label: results.pairs(first.name, second.name, arm.name) for arm in results.groups}
    present = {label: each for label, each in pairs.items() if each.size}
    if (count := sum(each.shape[1] for each in present.values())) < FEWEST_PROFILED:
        return
    label, agents = measure_label(results.measure), count_text(count, "agent")
    colours = groups.group_colours(results)
    # differences between set-ups are part of it
    whose = f"all {len(present)} set-ups together, {agents}" if len(present) > 1 else agents
    yield Drawing(
        "agreement",
        agreement(present, f"{label}, {first.label}", f"{label}, {second.label}", colours),
        f"{sentence_start(label)} of each agent: {second.label} over {first.label}.",
        f"Each agent on both: a dot on the dashed line has the same {label} on both. "
        f"Rank correlation over {whose}.{_one_colour(present, 'set-ups')}",
    )


def _one_colour(shown: Mapping[str, Array], name: str) -> str:
    """Return a note about groups that are too many to be told apart by colours; `name` says what they are."""
    return f" Colours do not distinguish the {name}." if len(shown) > MOST_LINES else ""


def rank_agreements(results: Sequence[StudyResults]) -> list[Drawing]:
    """Return how the order of agents in simulation agrees with that on the cart, for each score."""
    found = (_rank_agreement(results, measure) for measure in SCORES)
    return [each for each in found if each]


def _rank_agreement(results: Sequence[StudyResults], measure: str) -> Drawing | None:
    """Return the `measure` of all agents in the two evaluations that most studies compare; None for too few.

    Only studies of this measure count.
    """
    compared = [
        each for each in results if len(each.evaluations) > 1 and each.measure == measure and not each.varied
    ]
    names = Counter(_first_two(each) for each in compared)
    if not names:
        return None
    common, _ = names.most_common(1)[0]
    same = [each for each in compared if _first_two(each) == common]
    found = _pairs_by_study(same)
    agents = sum(each.shape[1] for each in found.values())
    if agents < FEWEST_PROFILED:
        return None
    first, second = same[-1].evaluations[:2]
    label = measure_label(measure)
    return Drawing(
        f"rank_agreement_{measure}",
        agreement(found, f"{label}, {first.label}", f"{label}, {second.label}"),
        f"{label} of {agents} agents of {len(found)} studies: {second.label} over {first.label}.",
        f"{agents} agents of {len(found)} studies. The dashed line: the same {label} on both. "
        f"The simulated cart is the nominal one of each agent's training.{_one_colour(found, 'studies')}",
        _verdict(found, label, first, second),
    )


def _first_two(results: StudyResults) -> tuple[str, str]:
    return results.evaluations[0].name, results.evaluations[1].name


def _pairs_by_study(results: Sequence[StudyResults]) -> dict[str, Array]:
    """Return the pairs [2, agents] of each study's title; an agent of several studies counts once."""
    known: set[str] = set()
    found: dict[str, Array] = {}
    for each in results:
        first, second = _first_two(each)
        compared = {
            each.identity(agent): (agent.values[first], agent.values[second])
            for agent in each.agents
            if {first, second} <= agent.values.keys()
        }
        if fresh := [pair for name, pair in compared.items() if name not in known]:
            title = each.title if each.title not in found else f"{each.title} ({each.name})"
            found[title] = np.array(fresh).T
        known |= compared.keys()
    return found


def _verdict(found: Mapping[str, Array], label: str, first: Named, second: Named) -> str:
    """Return in one sentence how far the order on the first cart predicts that on the second."""
    rho = rank_correlation(*np.concatenate([*found.values()], axis=1))
    if rho is None or rho.low is None or rho.high is None:
        return f"{sentence_start(label)}: too few agents for a rank correlation with an interval."
    if rho.low <= 0 <= rho.high:
        word = "is not shown to predict"
    elif rho.value < 0:
        word = "contradicts"
    else:
        word = "predicts well" if rho.value >= CLEAR else "predicts in part"
    return (
        f"{sentence_start(label)}: the order on the {first.label} {word} that on the {second.label}; over "
        f"{rho.agents} agents the rank correlation is {rho.value:.2f} (95 % interval {rho.low:.2f} to "
        f"{rho.high:.2f}; 1: the same order, 0: no relation)."
    )


def rank_correlation(values: ArrayLike, others: ArrayLike) -> Estimate | None:
    """Return Spearman's rho of the pairs of `values` [n] and `others` [n], agents resampled as pairs.

    None where it is undefined: fewer than two pairs, or no spread in one of them.
    """
    pairs = np.stack([np.asarray(values, dtype=float), np.asarray(others, dtype=float)])
    count, rho = pairs.shape[1], float(_spearman(pairs))
    if count < 2 or not np.isfinite(rho):
        return None
    if count < FEWEST_RANKED:
        return Estimate(rho, None, None, count)
    return bootstrap(lambda rows: _spearman(np.moveaxis(pairs[:, rows], 0, -2)), np.arange(count))


def _spearman(pairs: Array) -> Array:
    """Return rho of `pairs` [..., 2, n], Pearson's correlation of the ranks; NaN without spread."""
    ranks = stats.rankdata(pairs, axis=-1)  # ties at their mean rank
    ranks = ranks - ranks.mean(axis=-1, keepdims=True)
    covariance = (ranks[..., 0, :] * ranks[..., 1, :]).sum(-1)
    spread = np.sqrt(np.square(ranks).sum(-1).prod(-1))
    return np.divide(covariance, spread, out=np.full_like(spread, np.nan), where=spread > 0)


def curves_over_axis(lines: Lines, axis: str, measure: str, colours: Mapping[str, str]) -> Figure:
    """Draw the interquartile mean over a quantity, with its interval as a band, and every agent as a dot."""
    figure, axes = panel(lines)
    for label, (places, values) in lines.items():
        colour, found = colours[label], [estimate(each) for each in values]
        axes.plot(places, [each.value for each in found], color=colour, linewidth=2, marker="o", markersize=5)
        if all(each.low is not None for each in found):
            low, high = ([getattr(each, end) for each in found] for end in ("low", "high"))
            axes.fill_between(places, low, high, color=colour, alpha=0.2, linewidth=0)
        for place, each in zip(places, values, strict=True):
            axes.plot(np.full(each.size, place), each, "o", color=colour, alpha=0.45, markersize=3, mew=0)
    _tick_at(axes, sorted({place for places, _ in lines.values() for place in places}))
    finish(axes, {label: colours[label] for label in lines}, x=axis, y=measure)
    return figure


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


def agreement(shown: Mapping[str, Array], x: str, y: str, colours: Mapping[str, str] | None = None) -> Figure:
    """Draw one measure of each agent over another; `shown` maps a label to pairs [2, agents].

    More than MOST_LINES groups have one colour and no legend. The axes start at 0, or at the lowest value if
    all lie in the upper half.
    """
    figure, axes = panel(shown, groups.HEIGHT + 0.2)
    several = len(shown) <= MOST_LINES
    chosen = (colours or groups.palette([*shown])) if several else dict.fromkeys(shown, style.SERIES[0])
    for label, (first, second) in shown.items():
        axes.plot(first, second, "o", color=chosen[label], alpha=0.7, markersize=DOT + 1.5, mew=0)
    everything = np.concatenate(list(shown.values()), axis=1)
    low, high = float(everything.min()), float(everything.max())
    ends = [low if low > high / 2 else min(0.0, low), high]
    axes.plot(ends, ends, color=style.MUTED, linewidth=1, linestyle=DASHES, zorder=1)
    if rho := rank_correlation(*everything):
        text = f"rank correlation {rho.value:.2f}"
        text += "" if rho.low is None else f" ({rho.low:.2f} to {rho.high:.2f})"
        axes.set_title(text, loc="left", fontsize=style.SMALL_SIZE, color=style.INK)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=6))
    finish(axes, {label: chosen[label] for label in shown}, x=x, y=y)
    return figure
