"""A recorded episode beside the simulated cart that its motor values drive, and the prediction errors."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.identification.prediction import Replayed, all_errors, root_mean_square
from cartpole_rl.reporting import style
from cartpole_rl.reporting.figures.annotations import beside
from cartpole_rl.reporting.figures.behaviours import wrapped_line
from cartpole_rl.reporting.table import number_text

SIMULATED = style.VERMILLION
SMALLEST = 0.01  # mm and deg, of the logarithmic axes: less than one encoder count

Array = NDArray[np.float64]


def replay_figure(
    replays: Sequence[Replayed],
    period: float,
    times: Sequence[float],
    title: str = "Replay",
    subtitle: str = "",
) -> Figure:
    """Draw the first episode, measured and simulated, above the errors of all episodes.

    Above: angle (deg) and position (cm) over time (s). Below: absolute errors over the time since the reset,
    with the RMS over all stretches as a number at `times` (s).
    """
    figure = style.new_figure(height=8.2)
    above, below = figure.subfigures(2, 1, hspace=0.05, height_ratios=(1.75, 1.0), squeeze=False)[:, 0]
    angle, position = above.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    _draw_angle(angle, replays[0])
    _draw_position(position, replays[0])
    style.label(position, x="time (s)")
    style.title(angle, title, subtitle)
    above.align_ylabels()
    left, right = below.subplots(1, 2, sharex=True)
    errors = all_errors(replays)
    x_errors, theta_errors = 1e3 * errors[:, 0], np.degrees(errors[:, 1])
    lag = period * np.arange(len(errors), dtype=np.float64)
    _draw_errors(left, lag, x_errors, style.CART)
    _mark_times(left, lag, x_errors, times, "mm")
    _draw_errors(right, lag, theta_errors, style.POLE)
    _mark_times(right, lag, theta_errors, times, "deg")
    style.label(left, x="time since the reset (s)", y="cart error (mm)")
    style.label(right, x="time since the reset (s)", y="angle error (deg)")
    return figure


def _draw_angle(axes: Axes, replay: Replayed) -> None:
    style.dress(axes)
    style.label(axes, y="pole angle (deg)")
    episode = replay.episode
    axes.plot(*wrapped_line(episode.time, episode.theta), color=style.POLE, linewidth=3.2, alpha=0.45)
    for times, angles in zip(replay.time, replay.theta, strict=True):
        known = np.isfinite(angles)
        axes.plot(*wrapped_line(times[known], angles[known]), color=SIMULATED, linewidth=1.2)
        axes.plot(times[0], wrapped_line(times[:1], angles[:1])[1], "o", color=SIMULATED, markersize=3.5)
    axes.set_ylim(-190, 190)
    axes.set_yticks((-180, -90, 0, 90, 180))
    axes.set_xlim(episode.time[0], episode.time[-1])
    beside(axes, 0, "upright", style.MUTED)
    beside(axes, 180, "hanging", style.MUTED)


def _draw_position(axes: Axes, replay: Replayed) -> None:
    style.dress(axes)
    style.label(axes, y="cart (cm)")
    episode = replay.episode
    axes.plot(episode.time, 100 * episode.x, color=style.CART, linewidth=3.2, alpha=0.55, label="measured")
    for stretch, (times, positions) in enumerate(zip(replay.time, replay.x, strict=True)):
        name = "simulated, reset at each dot" if stretch == 0 else None
        axes.plot(times, 100 * positions, color=SIMULATED, linewidth=1.2, label=name)
        axes.plot(times[0], 100 * positions[0], "o", color=SIMULATED, markersize=3.5)
    reach = 1.2 * max(2.0, 100 * float(np.abs(episode.x).max()))
    axes.set_ylim(-reach, 1.5 * reach)
    axes.legend(
        loc="upper right", ncols=2, fontsize=style.SMALL_SIZE, frameon=True, framealpha=0.9, edgecolor="none"
    )


def _draw_errors(axes: Axes, lag: Array, errors: Array, colour: str) -> None:
    """Draw the absolute `errors` [T + 1, S] of all stretches and their RMS on a logarithmic axis."""
    style.dress(axes)
    sizes = np.maximum(np.abs(errors), SMALLEST)
    number = errors.shape[1]
    axes.plot(lag[1:], sizes[1:], color=colour, linewidth=0.7, alpha=min(0.5, 6 / number + 0.05))
    rms = np.maximum(root_mean_square(errors), SMALLEST)
    axes.plot(lag[1:], rms[1:], color=style.INK, linewidth=2.2)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlim(0, float(lag[-1]))
    style.title(axes, "", f"thick line: RMS of {number} stretches")


def _mark_times(axes: Axes, lag: Array, errors: Array, times: Sequence[float], unit: str) -> None:
    """Write the RMS error as a number at each of `times` that the stretches reach."""
    rms = np.maximum(root_mean_square(errors), SMALLEST)
    for time in times:
        index = int(np.abs(lag - time).argmin())
        if abs(lag[index] - time) > 1e-6 or not np.isfinite(rms[index]):
            continue
        axes.plot(lag[index], rms[index], "o", color=style.INK, markersize=5, clip_on=False, zorder=3)
        last = time > 0.8 * lag[-1]
        axes.annotate(
            f"{number_text(rms[index])} {unit}",
            xy=(lag[index], rms[index]),
            xytext=(-4 if last else 4, 7),
            textcoords="offset points",
            ha="right" if last else "left",
            fontsize=style.SMALL_SIZE,
            fontweight="bold",
            color=style.INK,
            bbox={"facecolor": style.PAPER, "alpha": 0.75, "edgecolor": "none", "pad": 1},
        )
