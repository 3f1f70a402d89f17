"""Colours, sizes and the style of all figures.

The colours are those of `drawing/colours.py`. Figures are built with matplotlib's object API, so nothing here
touches pyplot or global settings.
"""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cartpole_rl.drawing.colours import (  # noqa: F401 - figures read all of them as style.POLE, ...
    BLACK,
    BLUE,
    BROWN,
    CART,
    FAINT,
    GREEN,
    INK,
    LIMIT,
    MOTOR,
    MUTED,
    ORANGE,
    PAPER,
    POLE,
    PURPLE,
    SKY,
    UPRIGHT,
    VERMILLION,
)

SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BROWN, BLACK)
"""Colours of unrelated series, in order of use."""

WIDTH = 8.0  # inch, of every figure
DPI = 150  # of saved pictures
TITLE_SIZE = 13.0  # points
LABEL_SIZE = 11.0
SMALL_SIZE = 9.5


def series_colour(index: int) -> str:
    """Return the colour of the series `index`; the ninth has that of the first."""
    return SERIES[index % len(SERIES)]


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """Return an empty white figure of `width` by `height` inches whose layout has room for all labels."""
    return Figure(figsize=(width, height), layout="constrained", facecolor=PAPER)


def dress(axes: Axes, grid: str = "both") -> None:
    """Style `axes`: two spines, and a faint grid ("both", "x", "y" or "none") behind the data."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=SMALL_SIZE)
    axes.set_axisbelow(True)
    axes.grid(False)
    if grid != "none":
        axes.grid(True, axis=grid, color=FAINT, linewidth=0.8)  # type: ignore[arg-type]


def label(axes: Axes, x: str | None = None, y: str | None = None) -> None:
    """Label the axes; a label states its unit."""
    if x is not None:
        axes.set_xlabel(x, fontsize=LABEL_SIZE, color=INK)
    if y is not None:
        axes.set_ylabel(y, fontsize=LABEL_SIZE, color=INK)


def title(axes: Axes, text: str, subtitle: str = "") -> None:
    """Write a title over `axes`, and `subtitle` below it, smaller and grey."""
    room = 1.9 * SMALL_SIZE if subtitle else 0.8 * SMALL_SIZE
    axes.set_title(text, loc="left", fontsize=TITLE_SIZE, color=INK, fontweight="bold", pad=room)
    if subtitle:
        axes.annotate(
            subtitle,
            in_layout=False,  # the pad above makes room for it
            xy=(0, 1),
            xycoords="axes fraction",
            xytext=(0, 0.6 * SMALL_SIZE),
            textcoords="offset points",
            fontsize=SMALL_SIZE,
            color=MUTED,
        )
