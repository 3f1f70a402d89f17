"""Annotations inside and outside the panels of a figure."""

import re

from matplotlib.axes import Axes

from cartpole_rl.reporting import style

CONTROLS = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")  # no text of an SVG
LATE = 0.85  # share of a time axis; the text of a later time stands to its left


def plain(text: str) -> str:
    """Return a text that a figure shows as it is: between two $ matplotlib expects a formula."""
    return CONTROLS.sub("", text).replace("$", r"\$")


def beside(axes: Axes, height: float, text: str, colour: str) -> None:
    """Write `text` outside the right edge of a panel, at `height` in data units."""
    axes.annotate(
        text,
        xy=(1, height),
        xycoords=("axes fraction", "data"),
        xytext=(6, 0),
        textcoords="offset points",
        va="center",
        fontsize=style.SMALL_SIZE,
        color=colour,
        annotation_clip=False,
    )


def at_time(axes: Axes, time: float, text: str, colour: str) -> None:
    """Draw a dashed vertical line at `time` in data units, with `text` on the side where it fits."""
    axes.axvline(time, color=colour, linewidth=1.2, linestyle=(0, (4, 3)))
    start, end = axes.get_xlim()
    leftwards = time > start + LATE * (end - start)
    axes.annotate(
        text,
        xy=(time, 0.25),
        xycoords=("data", "axes fraction"),
        xytext=(-6 if leftwards else 6, 0),
        textcoords="offset points",
        ha="right" if leftwards else "left",
        va="center",
        fontsize=style.SMALL_SIZE,
        color=colour,
    )


def guide(axes: Axes, height: float, text: str, colour: str = style.MUTED) -> None:
    """Draw a dotted horizontal line at `height` in data units, with `text` outside the right edge."""
    axes.axhline(height, color=colour, linewidth=1.0, linestyle=(0, (3, 3)), zorder=1)
    beside(axes, height, text, colour)
