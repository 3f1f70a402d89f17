"""Figures as files, as bytes, or as SVG text for a page."""

import hashlib
import html
import io
import re
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from cartpole_rl.files import replacing
from cartpole_rl.reporting import style

PIXELS_PER_POINT = 1.35  # of a figure that has room; CSS's own is 1.33
PAGE_COLOURS = {  # of `style`: variable of the page's style sheet
    style.INK: "currentColor",
    style.MUTED: "var(--muted)",
    style.FAINT: "var(--faint)",
    style.PAPER: "var(--paper)",
    **{colour: f"var(--series-{index})" for index, colour in enumerate(style.SERIES)},
}

SHORTENED = (  # patterns in matplotlib's SVG, and their replacements
    (r"<metadata>.*?</metadata>", ""),
    (r"<defs>\s*<style.*?</style>\s*</defs>", ""),
    (r' id="[a-zA-Z][\w.]*_\d+"', ""),  # of groups, which nothing refers to
    (r"font-family: [^;]*; ", ""),
    (r"font: (?:[a-z]+ )*([\d.]+)px [^;\"]*", r"font-size: \1px"),
    (r"\s*\n\s*", "\n"),
)


def save(figure: Figure, path: Path | str) -> Path:
    """Write `figure` to `path` in the format of its suffix (.png, .pdf, .svg), and create its folder."""
    path = Path(path)
    with replacing(path) as beside:
        figure.savefig(beside, format=path.suffix.removeprefix("."), dpi=style.DPI)
    return path


def png(figure: Figure, dpi: float = style.DPI) -> bytes:
    """Return `figure` as the bytes of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def svg(figure: Figure, alt: str, place: str = "") -> str:
    """Return `figure` as an SVG element for a page, with the text `alt` for readers who cannot see it.

    Figures of a page with the same `alt` need a `place` each, so that their ids differ.
    Text stays text, the background is transparent, and the colours of `style` become the variables of the
    page's style sheet (`reporting.page`), so that the figure follows light and dark.
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
