"""Learning curves: the score of the evaluation episodes over the collected transitions (figure 6.9).

The thesis shows one agent; here every seed is drawn.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures.annotations import guide
from cartpole_rl.reporting.scores import SCORES
from cartpole_rl.tasks.settings import Measure

MILLION = 1e6

Record = Mapping[str, Any]
Run = Sequence[Record]
Array = NDArray[np.float64]


def learning_curve(
    histories: Sequence[tuple[str, Run]],
    threshold: float | None = None,
    guides: Mapping[str, float] | None = None,
    title: str = "Learning curve",
    measure: Measure = "score",
) -> Figure:
    """Draw the score of each evaluation over millions of transitions, one colour for each label.

    A history is a label and its records in order, one per evaluation: `transitions`, `seconds` of training,
    and over the episodes of that evaluation the `measure` (mean), `score_min`, `score_max`.
    **Runs that share a label are seeds of one set-up**: each is a thin line, their median a thick one. A
    single run is a thick line. The band spans the worst to the best episode of all runs of that label.
    `threshold` is a target score; `guides` are other named scores.
    Raises ConfigError for no history and for one without a record.
    """
    if not histories or not all(records for _, records in histories):
        raise ConfigError("a learning curve needs at least one run, and at least one evaluation in each")
    figure = style.new_figure(height=4.4)
    axes = figure.subplots()
    style.dress(axes)
    groups = _groups(histories)
    for index, (name, runs) in enumerate(groups.items()):
        _draw_group(axes, name, runs, style.series_colour(index), measure)
    _draw_guides(axes, guides or {}, threshold, [run for _, run in histories], measure)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, steps=(1, 2, 5, 10)))
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=min(0.0, axes.dataLim.y0))
    axes.legend(loc="lower right", fontsize=style.SMALL_SIZE, frameon=True, framealpha=0.9, edgecolor="none")
    style.label(axes, x="transitions (millions)", y=f"{SCORES[measure]} of an episode")
    lines = "thin lines: runs,  thick line: their median" if len(histories) > len(groups) else "line: mean"
    style.title(axes, title, f"{lines},  band: worst to best episode")
    return figure


def _groups(histories: Sequence[tuple[str, Run]]) -> dict[str, list[Run]]:
    """Return the runs of each label, in the order of the labels' first runs."""
    groups: dict[str, list[Run]] = {}
    for label, records in histories:
        groups.setdefault(label, []).append(records)
    return groups


def _column(run: Run, key: str) -> Array:
    """Return one key of a run's records as an array [evaluations]."""
    return np.array([record[key] for record in run], dtype=np.float64)


def _on_common_transitions(runs: Sequence[Run], key: str) -> tuple[Array, Array]:
    """Return transitions [F] that all runs reached, and `key` of each run there, interpolated [runs, F]."""
    transitions = [_column(run, "transitions") for run in runs]
    first, last = max(each[0] for each in transitions), min(each[-1] for each in transitions)
    shared = np.unique(np.concatenate(transitions))
    shared = shared[(first <= shared) & (shared <= last)]
    if not shared.size:  # runs whose ranges do not overlap
        shared = np.unique(np.concatenate(transitions))
    values = [np.interp(shared, own, _column(run, key)) for own, run in zip(transitions, runs, strict=True)]
    return shared, np.stack(values)


def _draw_group(axes: Axes, name: str, runs: Sequence[Run], colour: str, measure: Measure) -> None:
    """Draw the band, the thin line of each seed and the thick line of a label."""
    transitions, lowest = _on_common_transitions(runs, "score_min")
    _, highest = _on_common_transitions(runs, "score_max")
    axes.fill_between(
        transitions / MILLION, lowest.min(0), highest.max(0), color=colour, alpha=0.13, linewidth=0
    )
    if len(runs) > 1:
        for run in runs:
            axes.plot(
                _column(run, "transitions") / MILLION,
                _column(run, measure),
                color=colour,
                alpha=0.55,
                linewidth=0.9,
            )
        name = f"{name}: median of {len(runs)} runs"
    transitions, scores = _on_common_transitions(runs, measure)
    marker = "o" if len(transitions) == 1 else ""
    axes.plot(
        transitions / MILLION, np.median(scores, 0), marker=marker, color=colour, linewidth=2.2, label=name
    )


def _draw_guides(
    axes: Axes, guides: Mapping[str, float], threshold: float | None, runs: Sequence[Run], measure: Measure
) -> None:
    """Draw horizontal lines at named scores, and at the target, with when it was reached."""
    for name, score in guides.items():
        guide(axes, score, name)
    if threshold is not None:
        guide(axes, threshold, f"target {threshold:g}\n{_outcome(runs, threshold, measure)}", style.LIMIT)


def _reached(run: Run, threshold: float, measure: Measure) -> Record | None:
    """Return the first record whose mean score is at least `threshold`."""
    return next((record for record in run if record[measure] >= threshold), None)


def _outcome(runs: Sequence[Run], threshold: float, measure: Measure) -> str:
    """Return how many runs reached the threshold, and their median time."""
    hits = [record["seconds"] for run in runs if (record := _reached(run, threshold, measure))]
    if not hits:
        return "not reached"
    duration = _duration(float(np.median(hits)))
    return (
        f"reached after {duration}"
        if len(runs) == 1
        else f"{len(hits)} of {len(runs)} runs,\nmedian {duration}"
    )


def _duration(seconds: float) -> str:
    """Return a time in seconds below three minutes, in minutes above."""
    return f"{seconds:.0f} s" if seconds < 180 else f"{seconds / 60:.1f} min"
