"""Small text tables for terminals, with numbers rounded to what a reader can use."""

import math
from collections.abc import Mapping, Sequence

Cell = str | int | float | bool | None

MISSING = "–"
GAP = "  "
RULE = "─"
FIGURES = 3  # significant digits of the largest number of a column
MOST_DECIMALS = 6
LEANING = 0.25  # difference of the two half widths, as part of the wider, from which both ends are shown


def table(rows: Sequence[Mapping[str, Cell]], columns: Mapping[str, str] | Sequence[str]) -> str:
    """Rows as aligned text under a ruled heading, without a final newline.

    `columns` gives the keys to show, in order, or maps each to its heading. The numbers of a column share
    their decimals and stand to the right, as do texts that begin like a number ("4210 ± 85"); other texts
    stand to the left. A key that a row lacks, None and NaN show as a dash.
    """
    headings = dict(columns) if isinstance(columns, Mapping) else {key: key for key in columns}
    shown = [_column(heading, [row.get(key) for row in rows]) for key, heading in headings.items()]
    return "\n".join(GAP.join(cells).rstrip() for cells in zip(*shown, strict=True))


def interval_text(mean: float, low: float | None, high: float | None) -> str:
    """A mean with the half width of its interval, to two digits of that, or three of the mean: "4210 ± 85".

    An interval that leans to one side shows its ends instead, "4350 (4110 to 4420)"; one that is not finite,
    and None, as that of a single episode, leave the mean alone.
    """
    if low is None or high is None or not math.isfinite(high - low):
        return number_text(mean)
    below, above = mean - low, high - mean
    finest = _decimals(mean or max(below, above), FIGURES)
    decimals = min(_decimals(max(below, above), figures=2) if above > 0 or below > 0 else finest, finest)
    if abs(below - above) <= LEANING * max(below, above):
        return f"{mean:.{decimals}f} ± {(below + above) / 2:.{decimals}f}"
    return f"{mean:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f})"


def number_text(value: float) -> str:
    """A number with three significant digits, or all digits before the point: "4210", "12.3", "0.00456"."""
    return f"{value:.{_decimals(value, FIGURES)}f}" if math.isfinite(value) else MISSING


def _decimals(largest: float, figures: int) -> int:
    """Digits after the point that show `figures` significant digits of a number of this size."""
    if largest == 0 or not math.isfinite(largest):
        return 0
    return min(max(figures - 1 - math.floor(math.log10(abs(largest))), 0), MOST_DECIMALS)


def _column(heading: str, cells: Sequence[Cell]) -> list[str]:
    """Heading, rule and cells as texts of one width."""
    sizes = [abs(cell) for cell in cells if isinstance(cell, float) and math.isfinite(cell)]
    decimals = _decimals(max(sizes, default=0.0), FIGURES)
    texts = [_text(cell, decimals) for cell in cells]
    width = max(len(text) for text in (heading, *texts))
    rightwards = all(_is_numeric(text) for text in texts)
    aligned = [text.rjust(width) if rightwards else text.ljust(width) for text in (heading, *texts)]
    return [aligned[0], RULE * width, *aligned[1:]]


def _text(cell: Cell, decimals: int) -> str:
    """One cell as text; floats with the decimals of their column."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return MISSING
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return f"{cell:.{decimals}f}" if isinstance(cell, float) else str(cell)


def _is_numeric(text: str) -> bool:
    """Whether a text is a number, begins with one, or stands for a missing one."""
    return text == MISSING or text.lstrip("+-")[:1].isdigit()
