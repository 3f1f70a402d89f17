"""Texts that figures, tables and messages share, and text tables for terminals."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cartpole_rl.tasks.episode import Ending, Episode

Cell = str | int | float | bool | None

ENDINGS = {
    Ending.TIME: "time was up",
    Ending.TRACK: "left the track",
    Ending.ANGLE: "the pole fell",
    Ending.FAULT: "the cart reported a fault",
    Ending.LINK: "the link was lost",
    Ending.NON_FINITE: "a value was not finite",
}
SCORES = {  # key in metrics.json: label
    "score": "score (6.2)",
    "score_upright": "score upright (6.1)",
    "time_to_upright_s": "time to upright, s",
    "upright_fraction": "share of time upright",
    "recovered_fraction": "share of an episode's falls recovered from",  # None without a fall, as is the next
    "recovery_s": "recovery after a fall, s",
    "rms_angle_rad": "RMS angle while upright, rad",
    "rms_position_m": "RMS position while upright, m",
    "min_track_margin_m": "nearest to the track's end, m",
    "guarded_fraction": "share of time under the track guard",  # None without a guard
}
MISSING = "–"
GAP = "  "
RULE = "─"
DIGITS = 3  # significant, of the largest number of a column
MOST_DECIMALS = 6
ASYMMETRY = 0.25  # difference of the half widths, relative to the wider, above which both ends are shown


def table(rows: Sequence[Mapping[str, Cell]], columns: Mapping[str, str] | Sequence[str]) -> str:
    """Return rows as aligned text under a ruled heading, without a final newline.

    `columns` lists the keys to show, or maps each of them to its heading. The numbers of a column have the
    same decimals and are aligned to the right, as are texts that start with a number ("4210 ± 85"); other
    texts are aligned to the left. A missing key, None and NaN become a dash.
    """
    headings = dict(columns) if isinstance(columns, Mapping) else {key: key for key in columns}
    cells = [_column(heading, [row.get(key) for row in rows]) for key, heading in headings.items()]
    return "\n".join(GAP.join(line).rstrip() for line in zip(*cells, strict=True))


def score_table(summary: Mapping[str, Any], heading: str) -> str:
    """Return a table of the means in a summary of episodes (`evaluation.metrics.summarize`)."""
    return score_columns({"mean": summary}, heading)


def score_columns(summaries: Mapping[str, Mapping[str, Any]], heading: str) -> str:
    """Return a table with a column of means for each summary, by its name.

    The intervals of a row have one form: by their ends if one of them is asymmetric.
    """
    rows = []
    for key, label in SCORES.items():
        means = {name: summary.get(key) for name, summary in summaries.items()}
        if any(mean is not None for mean in means.values()):
            texts = {name: mean_text(mean) for name, mean in means.items()}
            if any(" to " in (text or "") for text in texts.values()):
                texts = {name: mean_text(mean, ends=True) for name, mean in means.items()}
            rows.append({"figure": label, **texts})
    return table(rows, {"figure": heading, **{name: name for name in summaries}})


def interval_text(
    mean: float, low: float | None, high: float | None, ends: bool = False, most_decimals: int = MOST_DECIMALS
) -> str:
    """Return a mean with the half width of its interval: "4210 ± 85".

    The half width has two significant digits, or fewer if the mean would have more than three. An asymmetric
    interval is written by its ends, "4350 (4110 to 4420)"; with `ends` every one. Without an interval (None
    or not finite) the mean stands alone.
    """
    if low is None or high is None or not math.isfinite(high - low):
        return number_text(mean, most_decimals)
    below, above = mean - low, high - mean
    finest = min(_decimals(mean or max(below, above), DIGITS), most_decimals)
    decimals = min(_decimals(max(below, above), digits=2) if above > 0 or below > 0 else finest, finest)
    if not ends and abs(below - above) <= ASYMMETRY * max(below, above):
        return f"{mean:z.{decimals}f} ± {(below + above) / 2:z.{decimals}f}"
    return f"{mean:z.{decimals}f} ({low:z.{decimals}f} to {high:z.{decimals}f})"


def mean_text(value: Mapping[str, Any] | None, ends: bool = False) -> str | None:
    """Return a mean with its interval, by its `ends` or as `interval_text` chooses; None without one."""
    return None if value is None else interval_text(value["mean"], value["low"], value["high"], ends)


def number_text(value: float, most_decimals: int = MOST_DECIMALS) -> str:
    """Return a number with at least three significant digits: "4210", "12.3", "0.00456"; a dash for NaN."""
    if not math.isfinite(value):
        return MISSING
    return f"{value:z.{min(_decimals(value, DIGITS), most_decimals)}f}"


def _decimals(largest: float, digits: int) -> int:
    """Return the decimals that give a number of this size `digits` significant digits."""
    if largest == 0 or not math.isfinite(largest):
        return 0
    return min(max(digits - 1 - math.floor(math.log10(abs(largest))), 0), MOST_DECIMALS)


def _column(heading: str, cells: Sequence[Cell]) -> list[str]:
    """Return heading, rule and cells as texts of the same width."""
    sizes = [abs(cell) for cell in cells if isinstance(cell, float) and math.isfinite(cell)]
    decimals = _decimals(max(sizes, default=0.0), DIGITS)
    texts = [_text(cell, decimals) for cell in cells]
    width = max(len(text) for text in (heading, *texts))
    rightwards = all(_is_numeric(text) for text in texts)
    aligned = [text.rjust(width) if rightwards else text.ljust(width) for text in (heading, *texts)]
    return [aligned[0], RULE * width, *aligned[1:]]


def _text(cell: Cell, decimals: int) -> str:
    """Return one cell as text; floats with the decimals of their column."""
    if cell is None or (isinstance(cell, float) and math.isnan(cell)):
        return MISSING
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    return f"{cell:.{decimals}f}" if isinstance(cell, float) else str(cell)


def _is_numeric(text: str) -> bool:
    """Return True for a text that is a number, starts with one, or is MISSING."""
    return text == MISSING or text.lstrip("+-")[:1].isdigit()


def count_text(count: int, unit: str = "episode") -> str:
    """Return "1 episode" or "20 episodes"."""
    return f"{count} {unit}{'' if count == 1 else 's'}"


def guard_text(*episodes: Episode) -> str:
    """Return ", guarded 3.2 %", the mean share of periods under the track guard; empty without one."""
    shares = [episode.guarded.mean() for episode in episodes if episode.guarded is not None]
    return f", guarded {100 * sum(shares) / len(shares):.1f} %" if shares else ""


def cut_off(episodes: Sequence[Episode]) -> Iterator[str]:
    """Yield a warning for each fault that ended some of the episodes early."""
    for ending in (Ending.LINK, Ending.FAULT, Ending.NON_FINITE):
        if count := sum(episode.ended_by == ending for episode in episodes):
            yield f"warning: {count} of {count_text(len(episodes))} ended early by {ending} (docs/safety.md)"


def ending_text(episode: Episode) -> str:
    """Return why and when an episode ended: "left the track after 6.6 s"."""
    return f"{ENDINGS[Ending(episode.ended_by)]} after {episode.time[-1] - episode.time[0]:.1f} s"
