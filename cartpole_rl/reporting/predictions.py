"""Figures and tables of prediction errors: of a replay, and of a learned model on held-out recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.drawing import colours
from cartpole_rl.identification.ensemble import Ensemble
from cartpole_rl.identification.prediction import Prediction, Replayed, all_errors, root_mean_square
from cartpole_rl.physics.residual import Residual
from cartpole_rl.reporting import style
from cartpole_rl.reporting.episodes import wrapped_line
from cartpole_rl.reporting.texts import number_text, table

REPORTED_TIMES = (0.1, 0.5, 1.0)  # s after a reset
PHYSICS, LEARNED = "physics alone", "physics + network"  # models that are compared
SIMULATED = colours.VERMILLION
LINES = (  # name, colour, dashes and width of the curves of a learned model
    (PHYSICS, colours.VERMILLION, "-", 2.2),
    (LEARNED, colours.BLUE, "-", 2.2),
    ("spread of the ensemble", colours.BLUE, (0, (2, 2)), 1.4),
)
SMALLEST = 0.01  # mm and deg, of the logarithmic axes: less than one encoder count
ERROR_COLUMNS = {
    "rms_x_mm": "cart RMS (mm)",
    "median_x_mm": "cart median (mm)",
    "rms_theta_deg": "angle RMS (deg)",
    "median_theta_deg": "angle median (deg)",
}

Array = NDArray[np.float64]
Errors = Sequence[Mapping[str, Any]]  # one mapping for each time after a reset: `prediction.errors_at`


def error_table(errors: Mapping[str, Errors], heading: str) -> str:
    """Return the errors of models at the same times as a table below `heading`; one model is not named."""
    first = next(iter(errors))
    rows = [
        {
            "time": f"{line['after_s']:g}" if model == first else "",
            "model": model,
            **{key: number_text(line[key]) for key in ERROR_COLUMNS},
        }
        for lines in zip(*errors.values(), strict=True)
        for model, line in zip(errors, lines, strict=True)
    ]
    models = {"model": "model"} if len(errors) > 1 else {}
    return f"{heading}\n{table(rows, {'time': 'time (s)', **models, **ERROR_COLUMNS})}"


def spread_table(errors: Errors, spreads: float, heading: str) -> str:
    """Return RMS errors beside RMS ensemble spreads, and the share of errors within `spreads` spreads."""
    columns, rows = {"time": "time (s)"}, [{"time": f"{line['after_s']:g}"} for line in errors]
    for name, unit in (("x", "cart error / spread (mm)"), ("theta", "angle error / spread (deg)")):
        columns |= {name: unit, f"within_{name}": f"within {spreads:g} spreads"}
        key = f"{name}_{'mm' if name == 'x' else 'deg'}"
        for row, line in zip(rows, errors, strict=True):
            row[name] = f"{number_text(line[f'rms_{key}'])} / {number_text(line[f'rms_spread_{key}'])}"
            row[f"within_{name}"] = f"{line[f'within_{key}']:.0%}"
    return f"{heading}\n{table(rows, columns)}"


def replay_figure(
    replays: Sequence[Replayed], period: float, times: Sequence[float], title: str, subtitle: str
) -> Figure:
    """Draw the first episode, measured and simulated, above the errors of all episodes.

    Above: angle (deg) and position (cm) over time (s). Below: absolute errors over the time since the reset,
    with the RMS over all stretches as a number at `times` (s).
    """
    figure = style.new_figure(height=8.2)
    above, below = figure.subfigures(2, 1, hspace=0.05, height_ratios=(1.75, 1.0), squeeze=False)[:, 0]
    angle, position = above.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    draw_angle(angle, replays[0])
    draw_position(position, replays[0])
    first = replays[0].episode
    angle.set_xlim(first.time[0], first.time[-1])
    style.beside(angle, 0, "upright", colours.MUTED)
    style.beside(angle, 180, "hanging", colours.MUTED)
    style.title(angle, title, subtitle)
    style.label(position, x="time (s)")
    reach = 1.2 * max(2.0, 100 * float(np.abs(first.x).max()))
    position.set_ylim(-reach, 1.5 * reach)
    looks: dict[str, Any] = {"frameon": True, "framealpha": 0.9, "edgecolor": "none"}
    position.legend(loc="upper right", ncols=2, fontsize=style.SMALL_SIZE, **looks)
    above.align_ylabels()
    errors = all_errors(replays)
    lag = period * np.arange(len(errors), dtype=np.float64)
    for axes, each, name, unit, colour in zip(
        below.subplots(1, 2, sharex=True),
        (1e3 * errors[:, 0], np.degrees(errors[:, 1])),
        ("cart error (mm)", "angle error (deg)"),
        ("mm", "deg"),
        (colours.CART, colours.POLE),
        strict=True,
    ):
        _draw_errors(axes, lag, each, colour)
        _mark_times(axes, lag, each, times, unit)
        style.label(axes, x="time since the reset (s)", y=name)
    return figure


def draw_angle(axes: Axes, replay: Replayed, hanging: bool = False) -> None:
    """Draw the measured and the simulated angle (deg) over time (s), from upright or from `hanging`."""
    style.dress(axes, y="from hanging (deg)" if hanging else "pole angle (deg)")
    episode, zero = replay.episode, np.pi if hanging else 0.0
    line = wrapped_line(episode.time, episode.theta - zero)
    axes.plot(*line, color=colours.POLE, linewidth=3, alpha=0.45, label="measured")
    for stretch, (times, angles) in enumerate(zip(replay.time, replay.theta - zero, strict=True)):
        known = np.isfinite(angles)
        _draw_stretch(axes, *wrapped_line(times[known], angles[known]), named=stretch == 0)
    axes.set_ylim(-190, 190)
    axes.set_yticks((-180, -90, 0, 90, 180))


def draw_position(axes: Axes, replay: Replayed) -> None:
    """Draw the measured and the simulated position (cm) over time (s)."""
    style.dress(axes, y="cart (cm)")
    episode = replay.episode
    axes.plot(episode.time, 100 * episode.x, color=colours.CART, linewidth=3, alpha=0.55, label="measured")
    for stretch, (times, positions) in enumerate(zip(replay.time, replay.x, strict=True)):
        _draw_stretch(axes, times, 100 * positions, named=stretch == 0)


def _draw_stretch(axes: Axes, times: Array, values: Array, named: bool) -> None:
    """Draw what is simulated from a reset on, which is a dot."""
    name = "simulated, reset at each dot" if named else None
    axes.plot(times, values, color=SIMULATED, linewidth=1.2, label=name)
    axes.plot(times[:1], values[:1], "o", color=SIMULATED, markersize=3.5)


def _draw_errors(axes: Axes, lag: Array, errors: Array, colour: str) -> None:
    """Draw the absolute `errors` [T + 1, S] of all stretches and their RMS on a logarithmic axis."""
    sizes, number = np.maximum(np.abs(errors), SMALLEST), errors.shape[1]
    axes.plot(lag[1:], sizes[1:], color=colour, linewidth=0.7, alpha=min(0.5, 6 / number + 0.05))
    _draw_over_time(axes, lag, errors, color=colours.INK, linewidth=2.2)
    style.title(axes, "", f"thick line: RMS of {number} stretches")


def _draw_over_time(axes: Axes, time: Array, errors: Array, **looks: Any) -> None:
    """Draw the RMS of errors [T + 1, S] on a logarithmic axis."""
    style.dress(axes)
    axes.plot(time[1:], np.maximum(root_mean_square(errors), SMALLEST)[1:], **looks)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlim(0, float(time[-1]))


def _mark_times(axes: Axes, lag: Array, errors: Array, times: Sequence[float], unit: str) -> None:
    """Write the RMS error as a number at each of `times` that the stretches reach."""
    rms = np.maximum(root_mean_square(errors), SMALLEST)
    for time in times:
        index = int(np.abs(lag - time).argmin())
        if abs(lag[index] - time) > lag[1] / 2 or not np.isfinite(rms[index]):
            continue
        place, last = (float(lag[index]), float(rms[index])), time > 0.8 * lag[-1]
        axes.plot(*place, "o", color=colours.INK, markersize=5, clip_on=False, zorder=3)
        box = {"facecolor": colours.PAPER, "alpha": 0.75, "edgecolor": "none", "pad": 1}
        looks: dict[str, Any] = {"ha": "right" if last else "left", "fontweight": "bold", "bbox": box}
        style.note(axes, f"{number_text(place[1])} {unit}", place, "data", (-4 if last else 4, 7), **looks)


def ensemble_figure(physics: Prediction, learned: Prediction, ensemble: Ensemble, subtitle: str) -> Figure:
    """Draw prediction errors above the force that the ensemble has learned, and the loss.

    Above: RMS errors of cart (mm) and angle (deg) over the time predicted, by physics alone and with the
    ensemble, and its spread. Below: the force of the members over the places that were visited, and the
    validation loss over the updates. Thin lines are members, thick lines their mean.
    """
    visited = ensemble.positions[:, 0].flatten().numpy()
    places, forces = forces_along_track(ensemble.best.as_float(), visited)
    updates, losses = np.array(ensemble.updates, dtype=np.float64), np.array(ensemble.history)
    figure = style.new_figure(height=6.6)
    time = ensemble.dynamics.period * np.arange(len(physics.error), dtype=np.float64)
    (cart, angle), (track, learning) = figure.subplots(2, 2)
    for axes, channel, factor in ((cart, 0, 1e3), (angle, 1, 180 / np.pi)):
        for each, (name, colour, dashes, width) in zip(
            (physics.error, learned.error, learned.spread), LINES, strict=True
        ):
            looks = {"color": colour, "linestyle": dashes, "linewidth": width, "label": name}
            _draw_over_time(axes, time, factor * each[:, channel], **looks)
    style.title(cart, "Learned model", subtitle)
    style.label(cart, x="prediction time (s)", y="RMS error, cart (mm)")
    style.label(angle, x="prediction time (s)", y="RMS error, angle (deg)")
    cart.legend(loc="lower right", fontsize=style.SMALL_SIZE, frameon=False)
    _draw_members(track, 100 * places, forces.T, "position on the track (cm)", "learned force (N)")
    known = places[np.isfinite(forces).all(0)]
    if len(known):
        track.set_xlim(100 * known.min(), 100 * known.max())
    _draw_members(learning, updates, losses, "updates", "validation loss")
    learning.set_xlim(0, updates[-1])
    learning.set_ylim(bottom=0)
    return figure


def forces_along_track(residual: Residual, visited: Array) -> tuple[Array, Array]:
    """Return places [K] in m and the tables' force [M, K] in N there, NaN at places not in `visited` (m)."""
    forces = (residual.units[0] * residual.widened_places()).numpy().astype(np.float64)
    spacing = float(residual.spacing)
    places = spacing * (np.arange(forces.shape[1]) - forces.shape[1] // 2)
    counts, _ = np.histogram(visited, np.append(places, places[-1] + spacing) - spacing / 2)
    return places, np.where(counts > 0, forces, np.nan)


def _draw_members(axes: Axes, at: Array, values: Array, x: str, y: str) -> None:
    """Draw the curve of each member, [K, M], and their mean."""
    style.dress(axes, x, y)
    axes.plot(at, values, color=colours.BLUE, linewidth=0.8, alpha=0.5)
    axes.plot(at, values.mean(1), color=colours.INK, linewidth=1.8)
