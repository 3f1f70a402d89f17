"""A recorded episode beside the simulated cart that its motor values drive, and how far the two part."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures.behaviours import wrapped_line
from cartpole_rl.reporting.figures.notes import beside
from cartpole_rl.reporting.table import number_text
from cartpole_rl.tasks.episode import Episode

SIMULATED = style.VERMILLION
SMALLEST = {"x": 0.01, "theta": 0.01}  # mm, deg: less is less than an encoder's count

Array = NDArray[np.float64]


def replay_figure(
    episode: Episode,
    time: Array,
    x: Array,
    theta: Array,
    lag: Array,
    x_errors: Array,
    theta_errors: Array,
    marked: Sequence[float],
    title: str = "Replay",
    note: str = "",
) -> Figure:
    """Above, x (cm) and theta (deg) over time (s), measured and simulated; below, the error over `lag`.

    The simulated `x` (m) and `theta` (rad, not wrapped) at `time` are [S, T], a row each stretch; NaN is left
    out. `x_errors` (m) and `theta_errors` (rad) are [E, L] of E stretches, of other episodes too, at `lag`
    [L] s after their beginnings; their RMS is told at the lags `marked`.
    """
    figure = style.new_figure(height=8.2)
    above, below = figure.subfigures(2, 1, hspace=0.05, height_ratios=(1.75, 1.0), squeeze=False)[:, 0]
    angle, position = above.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    _draw_angle(angle, episode, time, theta)
    _draw_position(position, episode, time, x)
    style.label(position, x="time (s)")
    style.title(angle, title, note)
    above.align_ylabels()
    left, right = below.subplots(1, 2, sharex=True)
    _draw_errors(left, lag, 1e3 * x_errors, marked, "mm", SMALLEST["x"], style.CART)
    _draw_errors(right, lag, np.degrees(theta_errors), marked, "deg", SMALLEST["theta"], style.POLE)
    style.label(left, x="since the restart (s)", y="error of the cart (mm)")
    style.label(right, x="since the restart (s)", y="error of the angle (deg)")
    return figure


def _draw_angle(axes: Axes, episode: Episode, time: Array, theta: Array) -> None:
    style.dress(axes)
    style.label(axes, y="pole angle (deg)")
    axes.plot(*wrapped_line(episode.time, episode.theta), color=style.POLE, linewidth=3.2, alpha=0.45)
    for moments, angles in zip(time, theta, strict=True):
        known = np.isfinite(angles)
        axes.plot(*wrapped_line(moments[known], angles[known]), color=SIMULATED, linewidth=1.2)
        axes.plot(moments[0], wrapped_line(moments[:1], angles[:1])[1], "o", color=SIMULATED, markersize=3.5)
    axes.set_ylim(-190, 190)
    axes.set_yticks((-180, -90, 0, 90, 180))
    axes.set_xlim(episode.time[0], episode.time[-1])
    beside(axes, 0, "upright", style.MUTED)
    beside(axes, 180, "hanging", style.MUTED)


def _draw_position(axes: Axes, episode: Episode, time: Array, x: Array) -> None:
    style.dress(axes)
    style.label(axes, y="cart (cm)")
    axes.plot(episode.time, 100 * episode.x, color=style.CART, linewidth=3.2, alpha=0.55, label="measured")
    for stretch, (moments, positions) in enumerate(zip(time, x, strict=True)):
        name = "simulated, restarted at each dot" if stretch == 0 else None
        axes.plot(moments, 100 * positions, color=SIMULATED, linewidth=1.2, label=name)
        axes.plot(moments[0], 100 * positions[0], "o", color=SIMULATED, markersize=3.5)
    reach = 1.2 * max(2.0, 100 * float(np.abs(episode.x).max()))
    axes.set_ylim(-reach, 1.5 * reach)
    axes.legend(
        loc="upper right", ncols=2, fontsize=style.NOTE_SIZE, frameon=True, framealpha=0.9, edgecolor="none"
    )


def _draw_errors(
    axes: Axes, lag: Array, errors: Array, marked: Sequence[float], unit: str, smallest: float, colour: str
) -> None:
    """The size of each stretch's error, their RMS, and the numbers at the marked lags; a logarithmic axis."""
    style.dress(axes)
    sizes = np.maximum(np.abs(errors), smallest)
    axes.plot(lag[1:], sizes[:, 1:].T, color=colour, linewidth=0.7, alpha=min(0.5, 6 / len(errors) + 0.05))
    rms = np.maximum(root_mean_square(errors), smallest)
    axes.plot(lag[1:], rms[1:], color=style.INK, linewidth=2.2)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlim(0, float(lag[-1]))
    for moment in marked:
        index = int(np.abs(lag - moment).argmin())
        if abs(lag[index] - moment) > 1e-6 or not np.isfinite(rms[index]):
            continue
        axes.plot(lag[index], rms[index], "o", color=style.INK, markersize=5, clip_on=False, zorder=3)
        last = moment > 0.8 * lag[-1]
        axes.annotate(
            f"{number_text(rms[index])} {unit}",
            xy=(lag[index], rms[index]),
            xytext=(-4 if last else 4, 7),
            textcoords="offset points",
            ha="right" if last else "left",
            fontsize=style.NOTE_SIZE,
            fontweight="bold",
            color=style.INK,
            bbox={"facecolor": style.PAPER, "alpha": 0.75, "edgecolor": "none", "pad": 1},
        )
    style.title(axes, "", f"thick: RMS of {len(errors)} stretches")


def root_mean_square(errors: Array) -> Array:
    """RMS [L] over the rows of `errors` [E, L] that are known there; NaN where none is."""
    known = np.isfinite(errors)
    count = known.sum(0)
    total = np.where(known, errors, 0.0) ** 2
    return np.sqrt(np.where(count > 0, total.sum(0) / np.maximum(count, 1), np.nan))
