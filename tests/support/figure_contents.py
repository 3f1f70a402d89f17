"""Reads what a figure shows."""

import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure


def line_of(axes: Axes, colour: str) -> np.ndarray:
    """Return the points [P, 2] of the longest line of a colour."""
    lines = [line for line in axes.lines if colors.same_color(line.get_color(), colour)]
    return max((line.get_xydata() for line in lines), key=len)


def words(figure: Figure) -> str:
    """Return every text of a figure."""
    figure.draw_without_rendering()
    return " | ".join(
        text.get_text() for text in figure.findobj(match=lambda each: hasattr(each, "get_text"))
    )
