"""Figures of an identification: friction and force, intervals, experiments, remaining uncertainty.

The first shows figures 5.2, 5.3 and 5.5 of the thesis for the identified cart.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.identification.prediction import Replayed
from cartpole_rl.identification.quantities import Quantity
from cartpole_rl.reporting import style
from cartpole_rl.reporting.curves import Curve
from cartpole_rl.reporting.figures.annotations import beside
from cartpole_rl.reporting.figures.behaviours import wrapped_line
from cartpole_rl.reporting.table import interval_text, number_text
from cartpole_rl.tasks.episode import Episode

IDENTIFIED, PRIOR, SIMULATED = style.BLUE, style.MUTED, style.VERMILLION
TAIL = 2.5  # percent beyond each end of an interval
LONGEST = 14.0  # s of an experiment that are drawn
FARTHEST = 12.0  # half widths of the interval; a prior value farther away becomes an arrow
WRITTEN = 0.3  # smallest weight in a combination that is written as a number
DARK = 0.6  # weight from which white digits are legible

Array = NDArray[np.floating]


def friction_and_force_figure(friction: Curve, force: Curve) -> Figure:
    """Draw friction (N) over velocity (m/s), and force (N) over motor value, with 95 % bands."""
    figure = style.new_figure(height=4.4)
    left, right = figure.subplots(1, 2)
    _draw_curve(left, friction, "Friction", "cart velocity (m/s)", "friction (N)")
    _draw_curve(right, force, "Force", "motor value", "force on the cart (N)")
    left.legend(fontsize=style.SMALL_SIZE, frameon=False, loc="upper left")
    return figure


def _draw_curve(axes: Axes, curve: Curve, title: str, x: str, y: str) -> None:
    style.dress(axes)
    low, high = np.percentile(curve.samples, [TAIL, 100 - TAIL], axis=1)
    axes.fill_between(curve.at, low, high, color=IDENTIFIED, alpha=0.25, linewidth=0)
    axes.plot(curve.at, curve.prior, color=PRIOR, linestyle=(0, (4, 3)), label="prior")
    axes.plot(curve.at, curve.identified, color=IDENTIFIED, linewidth=2, label="identified, 95 % band")
    style.label(axes, x=x, y=y)
    style.title(axes, title)


def interval_figure(quantities: Sequence[Quantity]) -> Figure:
    """Draw the 95 % interval of each quantity and its prior value, in units of the interval's half width."""
    figure = style.new_figure(height=1.2 + 0.36 * len(quantities))
    axes = figure.subplots()
    style.dress(axes, grid="x")
    for height, quantity in enumerate(reversed(quantities)):
        _draw_interval(axes, height, quantity)
    names = [quantity.words for quantity in reversed(quantities)]
    axes.set_yticks(range(len(names)), names, fontsize=style.SMALL_SIZE)
    axes.set_xlim(-FARTHEST - 1, FARTHEST + 1)
    style.label(axes, x="difference from the identified value\n(half widths of the 95 % interval)")
    style.title(axes, "Identified values", "blue: value and 95 % interval,  grey: prior")
    return figure


def _draw_interval(axes: Axes, height: int, quantity: Quantity) -> None:
    value, low, high, prior = quantity[3:]
    half = max((high - low) / 2, 1e-12)
    axes.plot(
        [(low - value) / half, (high - value) / half],
        [height, height],
        color=IDENTIFIED,
        linewidth=5,
        alpha=0.4,
        solid_capstyle="butt",
    )
    axes.plot(0, height, "o", color=IDENTIFIED)
    away = (prior - value) / half
    marker = "D" if abs(away) <= FARTHEST else (">" if away > 0 else "<")
    axes.plot(np.clip(away, -FARTHEST, FARTHEST), height, marker, color=PRIOR, markersize=6)
    text = f"{interval_text(value, low, high)} {quantity.unit}   (prior {number_text(prior)})"
    beside(axes, height, text, style.INK)


def experiments_figure(replays: Mapping[str, Replayed]) -> Figure:
    """Draw each experiment, measured and simulated: position (cm) and angle from hanging (deg) over time."""
    figure = style.new_figure(height=1.0 + 2.1 * len(replays), width=10.0)
    panels = figure.subplots(len(replays), 2, squeeze=False)
    for (left, right), (name, replay) in zip(panels, replays.items(), strict=True):
        _draw_positions(left, replay)
        _draw_angles(right, replay)
        start = _liveliest(replay.episode)
        for axes in (left, right):
            axes.set_xlim(start, min(start + LONGEST, float(replay.episode.time[-1])))
        style.title(left, name)
        style.label(left, y="cart (cm)")
        style.label(right, y="from hanging (deg)")
    for axes in panels[-1]:
        style.label(axes, x="time (s)")
    panels[0][1].legend(
        loc="lower right", ncols=2, fontsize=style.SMALL_SIZE, frameon=False, bbox_to_anchor=(1, 1)
    )
    return figure


def _liveliest(episode: Episode) -> float:
    """Return the start (s) of the LONGEST seconds in which the cart moves most."""
    way = np.concatenate((np.zeros(1), np.cumsum(np.abs(np.diff(episode.x)))))
    starts = episode.time[episode.time <= max(0.0, episode.time[-1] - LONGEST)]
    covered = np.interp(starts + LONGEST, episode.time, way) - np.interp(starts, episode.time, way)
    return float(starts[int(np.argmax(covered))])


def _draw_positions(axes: Axes, replay: Replayed) -> None:
    style.dress(axes)
    episode = replay.episode
    axes.plot(episode.time, 100 * episode.x, color=style.CART, linewidth=3, alpha=0.55, label="measured")
    for times, positions in zip(replay.time, replay.x, strict=True):
        known = np.isfinite(positions)
        axes.plot(times[known], 100 * positions[known], color=SIMULATED, linewidth=1.1)


def _draw_angles(axes: Axes, replay: Replayed) -> None:
    style.dress(axes)
    measured = wrapped_line(replay.episode.time, replay.episode.theta - np.pi)
    axes.plot(*measured, color=style.POLE, linewidth=3, alpha=0.45, label="measured")
    for index, (times, angles) in enumerate(zip(replay.time, replay.theta, strict=True)):
        known = np.isfinite(angles)
        line = wrapped_line(times[known], angles[known] - np.pi)
        axes.plot(*line, color=SIMULATED, linewidth=1.1, label="simulated" if index == 0 else None)
    axes.set_yticks((-180, -90, 0, 90, 180))
    axes.set_ylim(-190, 190)


def spectrum_figure(covariance: Array, names: Sequence[str]) -> Figure:
    """Draw the remaining uncertainty of combinations of parameters, the best known at the bottom.

    `covariance` [U, U] is in units of the prior variance; the combinations are its eigenvectors.
    """
    values, vectors = np.linalg.eigh(covariance)
    figure = style.new_figure(height=1.6 + 0.34 * len(names), width=11.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.7), sharey=True)
    rows = np.arange(len(values))
    style.dress(left, grid="x")
    left.barh(rows, np.sqrt(values), color=IDENTIFIED, alpha=0.7)
    left.axvline(1.0, color=PRIOR, linestyle=(0, (3, 3)))
    left.set_xscale("log")
    style.label(left, x="standard deviation / prior", y="combination")
    left.set_yticks(rows, [f"{row + 1}" for row in rows])
    style.title(left, "Remaining uncertainty", "dashed line: as uncertain as the prior")
    _draw_weights(right, vectors.T)
    right.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=style.SMALL_SIZE)
    style.title(right, "Combinations", "weight of each parameter")
    return figure


def _draw_weights(axes: Axes, weights: Array) -> None:
    """Draw the weights [combinations, parameters] as a picture, large ones as numbers too."""
    axes.imshow(np.abs(weights), aspect="auto", cmap="Blues", vmin=0, vmax=1, origin="lower")
    for row, column in zip(*np.nonzero(np.abs(weights) > WRITTEN), strict=True):
        weight = weights[row, column]
        colour = style.PAPER if abs(weight) > DARK else style.INK
        axes.text(column, row, f"{weight:+.1f}", ha="center", va="center", fontsize=7, color=colour)
