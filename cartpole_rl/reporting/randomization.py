"""The picture of what a randomization draws: a histogram of each parameter."""

import math
import textwrap
from itertools import combinations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from cartpole_rl.drawing.colours import BLUE, INK, MUTED
from cartpole_rl.errors import ConfigError
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.reporting import style
from cartpole_rl.rig.parameters import PARAMETERS

CARTS = 20_000
COLUMNS = 3
PANEL = 1.75  # inch, height
BARS = 60
NOTED = 0.2  # correlation from which a pair is named
MOST_PAIRS = 4
LONGEST_LINE = 100  # characters that are as wide as the figure
ABOUT = "Dashed: the nominal value; of a posterior, the median. Grey: the lowest and the highest drawn."


def drawn_carts(draws: Draws, seed: int) -> Figure:
    """Return histograms of CARTS carts. Raises ConfigError if every cart is the same."""
    table = draws.draw(CARTS, torch.Generator(draws.nominal.device).manual_seed(seed)).double().cpu().numpy()
    nominal = dict(zip(PARAMETERS, draws.nominal.tolist(), strict=True))
    varied = {name: row for name, row in zip(PARAMETERS, table, strict=True) if np.ptp(row) > 0}
    if not varied:
        raise ConfigError("preview: randomization draws the nominal cart alone; choose another one")
    rows = math.ceil(len(varied) / COLUMNS)
    figure = style.new_figure(PANEL * rows + 0.6)
    panels = [*figure.subplots(rows, COLUMNS, squeeze=False).flat]
    for axes, (name, values) in zip(panels, varied.items(), strict=False):
        _histogram(axes, name, values, nominal[name])
    for axes in panels[len(varied) :]:
        axes.set_axis_off()
    text = f"{CARTS} drawn carts. {ABOUT}{correlations(varied)}"
    figure.suptitle(text, fontsize=style.SMALL_SIZE, color=INK)
    return figure


def _histogram(axes: Axes, name: str, values: NDArray[np.float64], nominal: float) -> None:
    """Draw how often each value occurs, the nominal value and the ends."""
    style.dress(axes, grid="none")
    axes.hist(values, bins=BARS, color=BLUE)
    for end in (values.min(), values.max()):
        axes.axvline(end, color=MUTED, linewidth=0.8)
    axes.axvline(nominal, color=INK, linewidth=1.2, linestyle=(0, (4, 3)))
    axes.xaxis.set_major_locator(MaxNLocator(nbins=4))
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    unit = PARAMETERS[name].unit
    style.label(axes, f"{name} ({unit})" if unit != "1" else name)


def correlations(varied: dict[str, NDArray[np.float64]]) -> str:
    """Return lines with the most correlated pairs of parameters; empty if none is above NOTED."""
    matrix = np.atleast_2d(np.corrcoef([*varied.values()]))
    pairs = {
        f"{one} and {other} {matrix[first, second]:.2f}": abs(matrix[first, second])
        for (first, one), (second, other) in combinations(enumerate(varied), 2)
    }
    named = [pair for pair in sorted(pairs, key=pairs.__getitem__, reverse=True) if pairs[pair] >= NOTED]
    line = f"Correlation: {', '.join(named[:MOST_PAIRS])}."
    return f"\n{textwrap.fill(line, LONGEST_LINE)}" if named else ""
