"""Page, figures and tables of an identification.

The first figure shows figures 5.2, 5.3 and 5.5 of the thesis for the identified cart.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.drawing import colours
from cartpole_rl.identification.experiments import EXPERIMENTS
from cartpole_rl.identification.identify import (
    Candidate,
    Identification,
    PredictionError,
    Quantity,
    intervals,
)
from cartpole_rl.identification.prediction import Replayed
from cartpole_rl.identification.sensors import delayed
from cartpole_rl.physics.friction import viscous_coefficient
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.reporting import style, texts
from cartpole_rl.reporting.groups import evenly
from cartpole_rl.reporting.predictions import draw_angle, draw_position
from cartpole_rl.reporting.style import document, escaped, table
from cartpole_rl.reporting.texts import interval_text, number_text
from cartpole_rl.rig.hardware import LARGEST_MOTOR
from cartpole_rl.run_folder import FIGURES
from cartpole_rl.tasks.episode import Episode

CAPTIONS = {  # figures/<name>.png: caption
    "friction_and_force": "Friction of the cart and force of the motor, with 95 % bands",
    "intervals": "Identified values with 95 % intervals, and prior values",
    "experiments": "The experiments (at most 12), measured and simulated; the simulated cart is reset to the "
    "measured state every second",
    "held_out": "What was held out (at most 12) and not used in the fit",
    "unexplained": "Acceleration that the identified cart does not explain, median and quartiles: a cable "
    "or a tooth shows over the position, friction over the speed, a dead-band over the motor value",
    "spectrum": "Remaining uncertainty of each combination of parameters, relative to the prior",
}
FASTEST = 0.6  # m/s
MOST_SAMPLES = 500  # carts in a band
IDENTIFIED, PRIOR = colours.BLUE, colours.MUTED
TAIL = 2.5  # percent beyond each end of an interval
MOST_DRAWN = 12  # recordings
BINS, FEWEST = 25, 10  # of a figure's axis; samples in one that is drawn
SPACED = 0.02  # s between the positions of an acceleration, about
LONGEST = 14.0  # s of an experiment that are drawn
FARTHEST = 12.0  # half widths of the interval; a prior value farther away becomes an arrow
WRITTEN = 0.3  # smallest weight in a combination that is written as a number
DARK = 0.6  # weight from which white digits are legible

Array = NDArray[np.floating]
Parameters = Mapping[str, float]


def quantities_table(quantities: Sequence[Quantity]) -> str:
    """Return the identified quantities as a table for the terminal."""
    return texts.table(_quantity_rows(quantities), ("quantity", "value, 95 % interval", "unit"))


def error_text(error: PredictionError) -> str:
    """Return the errors of a prediction with their units, and of which seconds they are the median."""
    size = f"{1e3 * error.x:.2f} mm and {math.degrees(error.theta):.2f} deg"
    if not error.away:
        return f"{size}, the median of {error.stretches} seconds, none of them away from upright"
    return f"{size}, the median over the seconds away from upright ({error.away} of {error.stretches})"


def identification_figures(
    found: Identification, carts: Array, fitted: Iterable[str], held_out: Iterable[str]
) -> dict[str, Figure]:
    """Return the figures of CAPTIONS; `carts` [P, N] are drawn from the fit.

    `fitted` and `held_out` are the names of the recordings.
    """
    fit, models = found.fit, found.models
    return {
        "friction_and_force": friction_and_force_figure(
            friction_curve(fit.parameters, carts, fit.nominal, models.cart_friction),
            force_curve(fit.parameters, carts, fit.nominal, models.actuator),
        ),
        "intervals": interval_figure(intervals(fit, carts)),
        "experiments": experiments_figure(_drawn(fitted, found.fitted)),
        "held_out": experiments_figure(_drawn(held_out, found.held_out)),
        "unexplained": unexplained_figure(unexplained(found.fitted, fit.parameters["latency"])),
        "spectrum": spectrum_figure(fit.covariance, [unknown.name for unknown in fit.unknowns]),
    }


def _drawn(names: Iterable[str], replays: Iterable[Replayed]) -> dict[str, Replayed]:
    return dict(evenly([*zip(names, replays, strict=True)], MOST_DRAWN))


def identification_page(
    found: Identification, quantities: Sequence[Quantity], fitted: Mapping[str, Episode], next_command: str
) -> str:
    """Return the HTML page of an identification, which shows the figures of CAPTIONS in figures/."""
    title = "Identification of a cart"
    errors = (
        "The table's errors are medians over seconds of the recordings that were left out of these fits. "
        "RMS prediction error over one second of held-out motion, with the best model: "
        f"{error_text(found.error)}."
    )
    warnings = "".join(f"<li>{escaped(each)}</li>" for each in found.warnings or ["None."])
    parts = [
        f"<h1>{title}</h1>",
        f"<h2>Recordings</h2>\n{table(_recording_rows(fitted, found.dynamics.period))}",
        f"<h2>Identified values</h2>\n{table(_quantity_rows(quantities))}",
        f"<h2>Friction models of the cart</h2>\n{table(_friction_rows(found.candidates))}",
        f"<p>{escaped(errors)}</p>\n<h2>Warnings</h2>\n<ul>{warnings}</ul>",
        "<h2>Next step: train on carts like this one</h2>",
        f"<ul><li><code>{escaped(next_command)}</code></li></ul>",
        *(
            f'<h2>{caption}</h2>\n<img src="{FIGURES}/{name}.png" alt="{caption}">'
            for name, caption in CAPTIONS.items()
        ),
    ]
    return document(title, "\n".join(parts))


def _recording_rows(recordings: Mapping[str, Episode], period: float) -> list[dict[str, str]]:
    purposes = {experiment.name: experiment.shows for experiment in EXPERIMENTS}
    return [
        {
            "recording": name,
            "seconds": f"{episode.steps * period:.0f}",
            "purpose": purposes.get(name, ""),
            "ended by": episode.ended_by,
        }
        for name, episode in recordings.items()
    ]


def _quantity_rows(quantities: Sequence[Quantity]) -> list[dict[str, str]]:
    return [
        {
            "quantity": each.words,
            "value, 95 % interval": interval_text(each.value, each.low, each.high),
            "prior": number_text(each.prior),
            "unit": each.unit,
        }
        for each in quantities
    ]


def _friction_rows(candidates: Sequence[Candidate]) -> list[dict[str, str]]:
    return [
        {
            "cart_friction": each.cart_friction,
            "cart RMS error (mm)": f"{1e3 * each.error.x:.2f}",
            "angle RMS error (deg)": f"{math.degrees(each.error.theta):.2f}",
        }
        for each in candidates
    ]


class Curve(NamedTuple):
    """A curve at S places: of the identified cart, of N carts from the posterior, and of the prior."""

    at: Array  # [S]
    identified: Array  # [S]
    samples: Array  # [S, N]
    prior: Array  # [S]


def friction_curve(identified: Parameters, samples: Array, prior: Parameters, law: Law) -> Curve:
    """Return the cart's friction (N) over its velocity (m/s): figures 5.2 and 5.3 of the thesis.

    `samples` [P, N] are carts drawn from the posterior, a row each of `CartParameters.names()`.
    """
    velocity = torch.linspace(-FASTEST, FASTEST, 241, dtype=torch.float64)[:, None]

    def friction(cart: CartParameters) -> torch.Tensor:
        return law(velocity, cart) + viscous_coefficient(cart, law) * velocity

    return _curve(velocity, friction, identified, samples, prior)


def force_curve(identified: Parameters, samples: Array, prior: Parameters, actuator: Law) -> Curve:
    """Return the force (N) over the motor value: figure 5.5 of the thesis; see `friction_curve`."""
    motor = torch.arange(-LARGEST_MOTOR, LARGEST_MOTOR + 1, dtype=torch.float64)[:, None]
    return _curve(motor, lambda cart: actuator(motor, cart), identified, samples, prior)


def _curve(
    at: torch.Tensor,
    function: Callable[[CartParameters], torch.Tensor],
    identified: Parameters,
    samples: Array,
    prior: Parameters,
) -> Curve:
    def of_table(table: torch.Tensor) -> Array:
        return function(CartParameters(table[:, None])).numpy()

    def of_cart(cart: Parameters) -> Array:
        return of_table(cart_column(cart))[:, 0]

    band = of_table(torch.from_numpy(samples[:, :MOST_SAMPLES]))
    return Curve(at[:, 0].numpy(), of_cart(identified), band, of_cart(prior))


def friction_and_force_figure(friction: Curve, force: Curve) -> Figure:
    """Draw friction (N) over velocity (m/s), and force (N) over motor value, with 95 % bands."""
    figure = style.new_figure(height=4.4)
    left, right = figure.subplots(1, 2)
    _draw_curve(left, friction, "Friction", "cart velocity (m/s)", "friction (N)")
    _draw_curve(right, force, "Force", "motor value", "force on the cart (N)")
    left.legend(fontsize=style.SMALL_SIZE, frameon=False, loc="upper left")
    return figure


def _draw_curve(axes: Axes, curve: Curve, title: str, x: str, y: str) -> None:
    style.dress(axes, x, y)
    low, high = np.percentile(curve.samples, [TAIL, 100 - TAIL], axis=1)
    axes.fill_between(curve.at, low, high, color=IDENTIFIED, alpha=0.25, linewidth=0)
    axes.plot(curve.at, curve.prior, color=PRIOR, linestyle=(0, (4, 3)), label="prior")
    axes.plot(curve.at, curve.identified, color=IDENTIFIED, linewidth=2, label="identified, 95 % band")
    style.title(axes, title)


def interval_figure(quantities: Sequence[Quantity]) -> Figure:
    """Draw the 95 % interval of each quantity and its prior value, in units of the interval's half width."""
    figure = style.new_figure(height=1.2 + 0.36 * len(quantities))
    axes = figure.subplots()
    style.dress(axes, x="difference from the identified value\n(half widths of the 95 % interval)", grid="x")
    for height, quantity in enumerate(reversed(quantities)):
        _draw_interval(axes, height, quantity)
    names = [quantity.words for quantity in reversed(quantities)]
    axes.set_yticks(range(len(names)), names, fontsize=style.SMALL_SIZE)
    axes.set_xlim(-FARTHEST - 1, FARTHEST + 1)
    style.title(axes, "Identified values", "blue: value and 95 % interval,  grey: prior")
    return figure


def _draw_interval(axes: Axes, height: int, quantity: Quantity) -> None:
    value, low, high, prior = quantity[3:]
    half = max((high - low) / 2, 1e-12)
    ends = [(low - value) / half, (high - value) / half]
    axes.plot(ends, [height] * 2, color=IDENTIFIED, linewidth=5, alpha=0.4, solid_capstyle="butt")
    axes.plot(0, height, "o", color=IDENTIFIED)
    away = (prior - value) / half
    marker = "D" if abs(away) <= FARTHEST else (">" if away > 0 else "<")
    axes.plot(np.clip(away, -FARTHEST, FARTHEST), height, marker, color=PRIOR, markersize=6)
    text = f"{interval_text(value, low, high)} {quantity.unit}   (prior {number_text(prior)})"
    style.beside(axes, height, text, colours.INK)


def experiments_figure(replays: Mapping[str, Replayed]) -> Figure:
    """Draw each experiment, measured and simulated: position (cm) and angle from hanging (deg) over time."""
    figure = style.new_figure(height=1.0 + 2.1 * len(replays), width=10.0)
    panels = figure.subplots(len(replays), 2, squeeze=False)
    for (left, right), (name, replayed) in zip(panels, replays.items(), strict=True):
        draw_position(left, replayed)
        draw_angle(right, replayed, hanging=True)
        start = _liveliest(replayed.episode)
        for axes in (left, right):
            axes.set_xlim(start, min(start + LONGEST, float(replayed.episode.time[-1])))
        style.title(left, name)
    for axes in panels[-1]:
        style.label(axes, x="time (s)")
    looks: dict[str, Any] = {"frameon": False, "bbox_to_anchor": (1, 1)}
    panels[0][1].legend(loc="lower right", ncols=2, fontsize=style.SMALL_SIZE, **looks)
    return figure


class Unexplained(NamedTuple):
    """Accelerations of a cart that another one does not explain, and where they were measured, [K] each."""

    acceleration: Array  # m/s^2
    position: Array  # m
    speed: Array  # m/s
    motor: Array  # motor value in force


def unexplained(replays: Sequence[Replayed], latency: float) -> Unexplained:
    """Return the differences of the measured accelerations from those of the replays; `latency` in s."""
    parts = []
    for replayed in replays:
        period = float(replayed.time[0, 1] - replayed.time[0, 0])
        apart = max(1, round(SPACED / period))
        before, now, after = (slice(None, -2 * apart), slice(apart, -apart), slice(2 * apart, None))
        error, measured = -replayed.x_error, replayed.x - replayed.x_error
        rows = replayed.rows()[:, now]
        motor = delayed(replayed.episode.motor.astype(float), latency / period)
        values = (
            (error[:, before] - 2 * error[:, now] + error[:, after]) / (apart * period) ** 2,
            measured[:, now],
            (measured[:, after] - measured[:, before]) / (2 * apart * period),
            motor[np.minimum(rows, len(motor) - 1)],
        )
        known = np.isfinite(values[0])
        parts.append([each[known] for each in values])
    return Unexplained(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def unexplained_figure(found: Unexplained) -> Figure:
    """Draw what is not explained over the position, the speed and the motor value."""
    figure = style.new_figure(height=3.0, width=10.0)
    panels = figure.subplots(1, 3, sharey=True)
    for axes, values, x in zip(
        panels,
        (100 * found.position, found.speed, found.motor),
        ("position (cm)", "speed (m/s)", "motor value"),
        strict=True,
    ):
        edges = np.linspace(values.min(), values.max(), BINS + 1)
        groups = np.digitize(values, edges[1:-1])
        kept = [group for group in range(BINS) if (groups == group).sum() >= FEWEST]
        low, middle, high = (
            [np.percentile(found.acceleration[groups == group], share) for group in kept]
            for share in (25, 50, 75)
        )
        at = [(edges[group] + edges[group + 1]) / 2 for group in kept]
        style.dress(axes, x, "")
        axes.fill_between(at, low, high, color=IDENTIFIED, alpha=0.2, linewidth=0)
        axes.plot(at, middle, color=IDENTIFIED)
        axes.axhline(0, color=colours.MUTED, linewidth=0.8)
    style.label(panels[0], y="not explained (m/s²)")
    return figure


def _liveliest(episode: Episode) -> float:
    """Return the start (s) of the LONGEST seconds in which the cart moves most."""
    way = np.concatenate((np.zeros(1), np.cumsum(np.abs(np.diff(episode.x)))))
    starts = episode.time[episode.time <= max(episode.time[0], episode.time[-1] - LONGEST)]
    covered = np.interp(starts + LONGEST, episode.time, way) - np.interp(starts, episode.time, way)
    return float(starts[int(np.argmax(covered))])


def spectrum_figure(covariance: Array, names: Sequence[str]) -> Figure:
    """Draw the remaining uncertainty of combinations of parameters, the best known at the bottom.

    `covariance` [U, U] is in units of the prior variance; the combinations are its eigenvectors.
    """
    values, vectors = np.linalg.eigh(covariance)
    figure = style.new_figure(height=1.6 + 0.34 * len(names), width=11.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.7), sharey=True)
    rows = np.arange(len(values))
    style.dress(left, x="standard deviation / prior", y="combination", grid="x")
    left.barh(rows, np.sqrt(values), color=IDENTIFIED, alpha=0.7)
    left.axvline(1.0, color=PRIOR, linestyle=(0, (3, 3)))
    left.set_xscale("log")
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
        colour = colours.PAPER if abs(weight) > DARK else colours.INK
        axes.text(column, row, f"{weight:+.1f}", ha="center", va="center", fontsize=7, color=colour)
