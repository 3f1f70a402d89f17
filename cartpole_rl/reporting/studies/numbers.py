"""Numbers of studies as text: values with intervals, counts, shares and the names of measures."""

from typing import get_args

from cartpole_rl.reporting.studies.statistics import Estimate
from cartpole_rl.reporting.table import MOST_DECIMALS, interval_text, number_text
from cartpole_rl.tasks.settings import Measure

MEASURES = {  # key of metrics.json: label
    "score": "score (6.2)",
    "score_upright": "score (6.1)",
    "steps": "steps",
    "upright_fraction": "share of time upright",
    "upright_at_end": "share upright at the end",
    "time_to_upright_s": "time to upright, s",
    "errors.median": "median relative error of the parameters",
    "network_over_physics.theta_deg": "error of the angle, with / without network",
}
LOW_IS_GOOD = ("errors", "rms_", "time_to_", "network_over_")  # starts of measures
SCORES = get_args(Measure)
SCORE_DECIMALS = 1  # at most


def estimate_text(found: Estimate, measure: str = "") -> str:
    """Return an estimate with its interval: "4210 (4125 to 4295)"."""
    return interval_text(found.value, found.low, found.high, ends=True, most_decimals=_decimals(measure))


def value_text(value: float, measure: str) -> str:
    """Return a value of a measure: "4210"."""
    return number_text(value, _decimals(measure))


def _decimals(measure: str) -> int:
    return SCORE_DECIMALS if measure in SCORES else MOST_DECIMALS


def percent(share: float) -> str:
    """Return a share as "10 %"."""
    return f"{100 * share:.0f} %"


def counted_text(count: int, unit: str = "agent") -> str:
    """Return "1 agent" or "10 agents"."""
    return f"{count} {unit}{'' if count == 1 else 's'}"


def low_is_good(measure: str) -> bool:
    """Return True for a measure of which less is better."""
    return measure.startswith(LOW_IS_GOOD)


def measure_label(measure: str) -> str:
    """Return the name of a measure for axes and tables."""
    return MEASURES.get(measure, measure.replace("_", " ").replace(".", " "))


def sentence_start(text: str) -> str:
    """Return a text with a capital letter at its start."""
    return text[:1].upper() + text[1:]
