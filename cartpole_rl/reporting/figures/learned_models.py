"""Prediction errors of a learned model on held-out motion, and the force that it learned along the track."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.identification.ensemble import Ensemble
from cartpole_rl.identification.prediction import Prediction, root_mean_square
from cartpole_rl.physics.residual import SPACING, UNITS
from cartpole_rl.reporting import style, words
from cartpole_rl.rig.hardware import CART_METRES_PER_COUNT

PHYSICS, LEARNED = style.VERMILLION, style.BLUE
SMALLEST = 0.01  # mm and deg, of the logarithmic axes: less than one encoder count

Array = NDArray[np.float64]


def ensemble_figure(
    physics: Prediction, learned: Prediction, ensemble: Ensemble, subtitle: str = ""
) -> Figure:
    """Draw predictions by physics alone and by the ensemble, and what the ensemble has learned."""
    visited = ensemble.positions[:, 0].flatten().numpy() * CART_METRES_PER_COUNT
    return learned_model_figure(
        ensemble.dynamics.period,
        physics,
        learned,
        *forces_along_track(ensemble.best.as_float().places.numpy(), visited),
        np.array(ensemble.updates, dtype=np.float64),
        np.array(ensemble.history),
        subtitle=subtitle,
    )


def learned_model_figure(
    period: float,
    physics: Prediction,
    learned: Prediction,
    places: Array,
    forces: Array,
    updates: Array,
    losses: Array,
    title: str = "Learned model",
    subtitle: str = "",
) -> Figure:
    """Draw prediction errors above the learned force and the loss.

    Above: RMS errors of cart (mm) and angle (deg) over the time predicted, and the spread of the ensemble.
    Below: the `forces` [M, K] N of the members at `places` [K] m of the track, NaN for places that were never
    visited, and the validation `losses` [R, M] after `updates` [R]. Thin lines are members, thick lines their
    mean. `period` is the control period, s.
    """
    figure = style.new_figure(height=6.6)
    time = period * np.arange(len(physics.error), dtype=np.float64)
    (cart, angle), (track, learning) = figure.subplots(2, 2)
    for axes, channel, factor in ((cart, 0, 1e3), (angle, 1, 180 / np.pi)):
        curves = [
            factor * root_mean_square(each[:, channel])
            for each in (physics.error, learned.error, learned.spread)
        ]
        _draw_errors(axes, time, [np.maximum(curve, SMALLEST) for curve in curves])
    style.title(cart, title, subtitle)
    style.label(cart, x="prediction time (s)", y="RMS error, cart (mm)")
    style.label(angle, x="prediction time (s)", y="RMS error, angle (deg)")
    cart.legend(loc="lower right", fontsize=style.SMALL_SIZE, frameon=False)
    _draw_members(track, 100 * places, forces.T)
    style.label(track, x="position on the track (cm)", y="learned force (N)")
    visited = places[np.isfinite(forces).all(0)]
    if len(visited):
        track.set_xlim(100 * visited.min(), 100 * visited.max())
    _draw_members(learning, updates, losses)
    learning.set_xlim(0, updates[-1])
    learning.set_ylim(bottom=0)
    style.label(learning, x="updates", y="validation loss")
    return figure


def forces_along_track(outputs: Array, visited: Array) -> tuple[Array, Array]:
    """Return places [K] in m and the force [M, K] in N there, NaN at places that are not in `visited` (m).

    `outputs` [M, K] is the table over places of a `physics.residual.Residual`.
    """
    places = SPACING * (np.arange(outputs.shape[1]) - outputs.shape[1] // 2)
    counts, _ = np.histogram(visited, np.append(places, places[-1] + SPACING) - SPACING / 2)
    return places, np.where(counts > 0, UNITS[0] * outputs.astype(np.float64), np.nan)


def _draw_errors(axes: Axes, time: Array, curves: list[Array]) -> None:
    style.dress(axes)
    lines = (
        (words.PHYSICS, PHYSICS, "-", 2.2),
        (words.LEARNED, LEARNED, "-", 2.2),
        ("spread of the ensemble", LEARNED, (0, (2, 2)), 1.4),
    )
    for curve, (name, colour, dashes, width) in zip(curves, lines, strict=True):
        axes.plot(time[1:], curve[1:], color=colour, linestyle=dashes, linewidth=width, label=name)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlim(0, float(time[-1]))


def _draw_members(axes: Axes, at: Array, values: Array) -> None:
    """Draw the curve of each member, [K, M], and their mean."""
    style.dress(axes)
    axes.plot(at, values, color=LEARNED, linewidth=0.8, alpha=0.5)
    axes.plot(at, values.mean(1), color=style.INK, linewidth=1.8)
