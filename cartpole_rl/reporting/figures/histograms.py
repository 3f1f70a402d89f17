"""Histograms of the parameters that a randomization draws."""

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting import style

COLUMNS = 4
BINS = 24


def randomization_histograms(
    draws: Mapping[str, ArrayLike],
    nominal: Mapping[str, float] | None = None,
    title: str = "Randomized parameters",
) -> Figure:
    """Draw a small histogram of each parameter.

    `draws` maps a parameter, named with its unit, to its draws [carts]; `nominal` maps parameters to the
    value they vary around, drawn as a line. A parameter that never varies is said to be fixed.
    Raises ConfigError for no parameter and for one without a finite draw.
    """
    values = {name: _finite(name, each) for name, each in draws.items()}
    if not values:
        raise ConfigError("randomization histograms need at least one parameter")
    columns = min(COLUMNS, len(values))
    rows = math.ceil(len(values) / columns)
    figure = style.new_figure(height=0.7 + 1.55 * rows, width=max(4.0, style.WIDTH * columns / COLUMNS))
    panels = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for panel, (name, each) in zip(panels, values.items(), strict=False):
        _draw_parameter(panel, name, each, (nominal or {}).get(name))
    for panel in panels[len(values) :]:
        panel.set_visible(False)
    carts = max(each.size for each in values.values())
    line = ";  line: nominal" if nominal else ""
    figure.suptitle(
        f"{title}  ({carts} draws{line})",
        x=0.01,
        ha="left",
        fontsize=style.TITLE_SIZE,
        fontweight="bold",
        color=style.INK,
    )
    return figure


def _finite(name: str, draws: ArrayLike) -> NDArray[np.float64]:
    """Return the finite draws of a parameter, flat. Raises ConfigError if there are none."""
    values = np.asarray(draws, dtype=np.float64).ravel()
    values = values[np.isfinite(values)]
    if not values.size:
        raise ConfigError(f"parameter {name!r} has no finite draw to show")
    return values


def _draw_parameter(axes: Axes, name: str, values: NDArray[np.float64], nominal: float | None) -> None:
    """Draw the histogram of one parameter and its nominal value, or the value of one that is fixed."""
    style.dress(axes, grid="none")
    axes.set_title(name, fontsize=style.SMALL_SIZE, color=style.INK, loc="left")
    axes.spines["left"].set_visible(False)
    axes.set_yticks([])
    axes.xaxis.set_major_locator(MaxNLocator(nbins=4, steps=(1, 2, 5, 10)))
    low, high = float(values.min()), float(values.max())
    if math.isclose(low, high, rel_tol=1e-6, abs_tol=1e-12):
        axes.set_xticks([])
        axes.text(
            0.5,
            0.5,
            f"fixed at {low:.4g}",
            transform=axes.transAxes,
            ha="center",
            va="center",
            fontsize=style.SMALL_SIZE,
            color=style.MUTED,
        )
        return
    axes.hist(values, bins=BINS, range=(low, high), color=style.BLUE, alpha=0.8)
    if nominal is not None:
        axes.axvline(nominal, color=style.LIMIT, linewidth=1.6)
