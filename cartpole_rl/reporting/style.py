"""The look of figures and of the HTML pages that show them.

The colours are those of `drawing/colours.py`. Figures are built with matplotlib's object API, so nothing here
touches pyplot or a global setting, and figures may be made in any thread. Pages are read on a phone, on a
desk and on paper, in light and dark; they need no other file, no network and no script.
"""

import hashlib
import html
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cartpole_rl.drawing import filled
from cartpole_rl.drawing.colours import (
    BLACK,
    BLUE,
    BROWN,
    FAINT,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    PURPLE,
    SKY,
    VERMILLION,
)
from cartpole_rl.files import replacing

# colours of unrelated series, in order of use
SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BROWN, BLACK)

WIDTH = 8.0  # inch, of every figure
DPI = 150  # of saved pictures
TITLE_SIZE = 13.0  # points
LABEL_SIZE = 11.0
SMALL_SIZE = 9.5
LATE = 0.85  # share of a time axis; the text of a later time stands to its left
CONTROLS = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f]")  # no text of an SVG
PIXELS_PER_POINT = 1.35  # of a figure that has room; CSS's own is 1.33
PAGE_COLOURS = {  # variable of the page's style sheet
    INK: "currentColor",
    MUTED: "var(--muted)",
    FAINT: "var(--faint)",
    PAPER: "var(--paper)",
    **{colour: f"var(--series-{index})" for index, colour in enumerate(SERIES)},
}
Place = tuple[float, float]
SHORTENED = (  # patterns in matplotlib's SVG, and their replacements
    (r"<metadata>.*?</metadata>", ""),
    (r"<defs>\s*<style.*?</style>\s*</defs>", ""),
    (r' id="[a-zA-Z][\w.]*_\d+"', ""),  # of groups, which nothing refers to
    (r"font-family: [^;]*; ", ""),
    (r"font: (?:[a-z]+ )*([\d.]+)px [^;\"]*", r"font-size: \1px"),
    (r"\s*\n\s*", "\n"),
)


def series_colour(index: int) -> str:
    """Return the colour of the series `index`; the ninth has that of the first."""
    return SERIES[index % len(SERIES)]


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """Return an empty white figure of `width` by `height` inches whose layout has room for all labels."""
    return Figure(figsize=(width, height), layout="constrained", facecolor=PAPER)


def dress(axes: Axes, x: str | None = None, y: str | None = None, grid: str = "both") -> None:
    """Style `axes`: labels, two spines, and a faint grid ("both", "x", "y" or "none") behind the data."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=SMALL_SIZE)
    axes.set_axisbelow(True)
    axes.grid(False)
    if grid != "none":
        axes.grid(True, axis=grid, color=FAINT, linewidth=0.8)  # type: ignore[arg-type]
    label(axes, x, y)


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
    if subtitle:  # the pad above makes room for it
        note(axes, subtitle, (0, 1), "axes fraction", (0, 0.6 * SMALL_SIZE), MUTED, in_layout=False)


def note(
    axes: Axes, text: str, place: Place, of: Any, offset: Place, colour: str = INK, **looks: Any
) -> None:
    """Write a small text `offset` points from a `place` in the coordinates that matplotlib calls `of`."""
    given = {"textcoords": "offset points", "fontsize": SMALL_SIZE, "color": colour, **looks}
    axes.annotate(text, xy=place, xycoords=of, xytext=offset, **given)


def plain(text: str) -> str:
    """Return a text that a figure shows as it is: between two $ matplotlib expects a formula."""
    return CONTROLS.sub("", text).replace("$", r"\$")


def beside(axes: Axes, height: float, text: str, colour: str) -> None:
    """Write `text` outside the right edge of a panel, at `height` in data units."""
    of = "axes fraction", "data"
    note(axes, text, (1, height), of, (6, 0), colour, va="center", annotation_clip=False)


def at_time(axes: Axes, time: float, text: str, colour: str) -> None:
    """Draw a dashed vertical line at `time` in data units, with `text` on the side where it fits."""
    axes.axvline(time, color=colour, linewidth=1.2, linestyle=(0, (4, 3)))
    start, end = axes.get_xlim()
    side = -1 if time > start + LATE * (end - start) else 1
    aligned = "right" if side < 0 else "left"
    note(axes, text, (time, 0.25), ("data", "axes fraction"), (6 * side, 0), colour, ha=aligned, va="center")


def save(figure: Figure, path: Path) -> None:
    """Write `figure` to `path` in the format of its suffix (.png, .pdf, .svg), and create its folder."""
    with replacing(path) as part:
        figure.savefig(part, format=path.suffix.removeprefix("."), dpi=DPI)


def png(figure: Figure, dpi: float = DPI) -> bytes:
    """Return `figure` as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def svg(figure: Figure, alt: str, place: str = "") -> str:
    """Return `figure` as an SVG element for a page, with the text `alt` for readers who cannot see it.

    Figures of a page with the same `alt` need a `place` each, so that their ids differ.
    Text stays text, the background is transparent, and the colours of `style` become the variables of the
    page's style sheet, so that the figure follows light and dark.
    """
    buffer = io.StringIO()
    salt = hashlib.sha256(f"{place}\n{alt}".encode()).hexdigest()  # of the ids
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = buffer.getvalue()
    for pattern, replacement in SHORTENED:
        text = re.sub(pattern, replacement, text, flags=re.S)
    text = re.sub("#[0-9a-fA-F]{6}", lambda match: PAGE_COLOURS.get(match[0].upper(), match[0]), text)
    opening, body = re.split("(?<=>)", text[text.index("<svg") :], maxsplit=1)
    view = re.search(r'viewBox="0 0 ([\d.]+) [\d.]+"', opening)
    assert view
    size = f'style="max-width: {PIXELS_PER_POINT * float(view[1]):.0f}px"'
    return f'<svg role="img" aria-label="{html.escape(alt)}" {size} {view[0]}>{body}'


LIGHTER = ("#4AA3DF", "#FF7B39", "#2FC79B", "#E39CC0", "#F2B430", "#A5DBF8", "#CF9256", "#F0F0F0")
LIGHT = {
    "ink": INK,
    "muted": MUTED,
    "faint": FAINT,
    "paper": PAPER,
    "link": "#00588A",
    "alarm": "#A8420A",
    **{f"series-{index}": colour for index, colour in enumerate(SERIES)},
}
DARK = {  # the same hues, lighter
    "ink": "#E6E6E6",
    "muted": "#A0A0A0",
    "faint": "#383C42",
    "paper": "#16181C",
    "link": "#7CC4F5",
    "alarm": "#FF9B66",
    **{f"series-{index}": colour for index, colour in enumerate(LIGHTER)},
}


def _variables(colours: Mapping[str, str]) -> str:
    return " ".join(f"--{name}: {colour};" for name, colour in colours.items())


PAGE_STYLE = filled(
    Path(__file__).with_name("style.css"),
    {"light": _variables(LIGHT), "dark": _variables(DARK), "paper": PAPER},
)
NUMBER = re.compile(r"-?\d[\w.,%±() –-]{0,28}$")  # "4104 (4062 to 4177)", "10 of 10"


class Html(str):
    """Text that is HTML already: `escaped` leaves it as it is."""


def escaped(content: Any) -> str:
    """Return `content` as HTML."""
    return content if isinstance(content, Html) else html.escape(str(content))


def document(title: str, body: str, extra_style: str = "") -> str:
    """Return the whole page with this body."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>\n{PAGE_STYLE}{extra_style}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def table(rows: Sequence[Mapping[str, Any]], cards: bool = False) -> Html:
    """Return a table headed by the keys of the first row; with `cards` a phone shows each row as a list."""
    head = "".join(f"<th>{html.escape(key)}</th>" for key in rows[0])
    body = "".join(f"<tr>{''.join(_cell(key, cell) for key, cell in row.items())}</tr>" for row in rows)
    opening = '<table class="cards">' if cards else "<table>"
    return Html(f"{opening}<tr>{head}</tr>{body}</table>")


def _cell(key: str, content: Any) -> str:
    """Return a cell; one that starts with a number and is short stays on one line."""
    text = escaped(content)
    kind = ' class="number"' if NUMBER.match(text) else ""
    return f'<td{kind} data-label="{html.escape(key)}">{text}</td>'
