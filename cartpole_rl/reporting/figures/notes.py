"""Words in a figure, outside and inside its panels."""

from matplotlib.axes import Axes

from cartpole_rl.reporting import style

LATE = 0.85  # of a time axis; words about a later moment stand to its left


def beside(axes: Axes, height: float, word: str, colour: str) -> None:
    """A word outside the right edge of a panel, at `height` in data units."""
    axes.annotate(
        word,
        xy=(1, height),
        xycoords=("axes fraction", "data"),
        xytext=(6, 0),
        textcoords="offset points",
        va="center",
        fontsize=style.NOTE_SIZE,
        color=colour,
        annotation_clip=False,
    )


def at_moment(axes: Axes, moment: float, words: str, colour: str) -> None:
    """A dashed vertical line at `moment` in data units, and words next to it where they fit."""
    axes.axvline(moment, color=colour, linewidth=1.2, linestyle=(0, (4, 3)))
    start, end = axes.get_xlim()
    leftwards = moment > start + LATE * (end - start)
    axes.annotate(
        words,
        xy=(moment, 0.25),
        xycoords=("data", "axes fraction"),
        xytext=(-6 if leftwards else 6, 0),
        textcoords="offset points",
        ha="right" if leftwards else "left",
        va="center",
        fontsize=style.NOTE_SIZE,
        color=colour,
    )


def guide(axes: Axes, height: float, word: str, colour: str = style.MUTED) -> None:
    """A dotted horizontal line at `height` in data units, named outside the right edge."""
    axes.axhline(height, color=colour, linewidth=1.0, linestyle=(0, (3, 3)), zorder=1)
    beside(axes, height, word, colour)
