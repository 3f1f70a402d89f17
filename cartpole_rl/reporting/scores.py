"""Table of the scores of an evaluation."""

from collections.abc import Mapping
from typing import Any

from cartpole_rl.reporting.table import interval_text, table

SCORES = {  # key in metrics.json: label
    "score": "score (6.2)",
    "score_upright": "score upright (6.1)",
    "time_to_upright_s": "time to upright, s",
    "upright_fraction": "share of time upright",
    "rms_angle_rad": "RMS angle while upright, rad",
    "rms_position_m": "RMS position while upright, m",
    "min_track_margin_m": "nearest to the track's end, m",
    "guarded_fraction": "share of time under the track guard",  # None without a guard
}


def score_table(summary: Mapping[str, Any], heading: str) -> str:
    """Return a table of the means in a summary of episodes (`evaluation.metrics.summarize`)."""
    return score_columns({"mean": summary}, heading)


def score_columns(summaries: Mapping[str, Mapping[str, Any]], heading: str) -> str:
    """Return a table with a column of means for each summary, by its name."""
    rows = [
        {"figure": label, **{name: mean_text(summary[key]) for name, summary in summaries.items()}}
        for key, label in SCORES.items()
        if any(summary[key] is not None for summary in summaries.values())
    ]
    return table(rows, {"figure": heading, **{name: name for name in summaries}})


def mean_text(value: Mapping[str, Any] | None) -> str | None:
    """Return a mean with its interval; None without one."""
    return None if value is None else interval_text(value["mean"], value["low"], value["high"])
