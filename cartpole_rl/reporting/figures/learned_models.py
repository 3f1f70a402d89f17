"""What a learned model is worth on held-out motion, and what it learned about places along the track."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.reporting import style

PHYSICS, LEARNED = style.VERMILLION, style.BLUE
SMALLEST = (0.01, 0.01)  # mm, deg: less is less than an encoder's count

Array = NDArray[np.float64]


def learned_model_figure(
    ahead: Array,
    physics: Array,
    learned: Array,
    spread: Array,
    places: Array,
    forces: Array,
    updates: Array,
    losses: Array,
    title: str = "Learned model",
    note: str = "",
) -> Figure:
    """Above, RMS errors of cart (mm) and angle (deg) over `ahead` [H] s of predicting, with the spread.

    Errors `physics` and `learned`, and the members' `spread`, are [H, 2, W] in m and rad. Below, the `forces`
    [M, K] N that the members place along the track at `places` [K] m, NaN where the cart never was; and their
    `losses` [R, M] on what each left out, after so many `updates` [R]. Thin lines are members, thick ones
    their mean.
    """
    figure = style.new_figure(height=6.6)
    (cart, angle), (track, learning) = figure.subplots(2, 2)
    for axes, channel, factor in ((cart, 0, 1e3), (angle, 1, 180 / np.pi)):
        curves = [factor * root_mean_square(each[:, channel]) for each in (physics, learned, spread)]
        _draw_errors(axes, ahead, [np.maximum(curve, SMALLEST[channel]) for curve in curves])
    style.title(cart, title, note)
    style.label(cart, x="predicted ahead (s)", y="RMS error, cart (mm)")
    style.label(angle, x="predicted ahead (s)", y="RMS error, angle (deg)")
    cart.legend(loc="lower right", fontsize=style.NOTE_SIZE, frameon=False)
    _draw_members(track, 100 * places, forces.T)
    style.label(track, x="place on the track (cm)", y="force by place (N)")
    known = places[np.isfinite(forces).all(0)]
    if len(known):
        track.set_xlim(100 * known.min(), 100 * known.max())
    _draw_members(learning, updates, losses)
    learning.set_xlim(0, updates[-1])
    learning.set_ylim(bottom=0)
    style.label(learning, x="updates", y="loss on windows left out")
    return figure


def root_mean_square(values: Array) -> Array:
    """RMS of the last axis."""
    return np.sqrt((values**2).mean(-1))


def _draw_errors(axes: Axes, ahead: Array, curves: list[Array]) -> None:
    style.dress(axes)
    lines = (
        ("physics alone", PHYSICS, "-", 2.2),
        ("physics + network", LEARNED, "-", 2.2),
        ("spread of the members", LEARNED, (0, (2, 2)), 1.4),
    )
    for curve, (name, colour, dashes, width) in zip(curves, lines, strict=True):
        axes.plot(ahead[1:], curve[1:], color=colour, linestyle=dashes, linewidth=width, label=name)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlim(0, float(ahead[-1]))


def _draw_members(axes: Axes, at: Array, values: Array) -> None:
    """Each member's curve, [K, M], and their mean."""
    style.dress(axes)
    axes.plot(at, values, color=LEARNED, linewidth=0.8, alpha=0.5)
    axes.plot(at, values.mean(1), color=style.INK, linewidth=1.8)
