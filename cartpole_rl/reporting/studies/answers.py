"""Our answer to a study in words, and how it stands: what fails or contradicts comes first on the page."""

from collections.abc import Mapping
from enum import StrEnum

from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.reporting.studies.settings import Variant
from cartpole_rl.reporting.studies.statistics import Estimate, estimate
from cartpole_rl.reporting.table import interval_text

GOOD = {"score": 2000.0}  # measure: value above which the thesis calls an agent good (section 6)
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
THESIS_ROWS = {  # of the thesis's list: what must work
    1: "Physics, both integrators, substeps",
    2: "Balance with reward (5.1), three actions",
    3: "Balance with reward (6.1)",
    4: "Swing-up in the stock simulation",
    5: "Nine actions, linear and measured spacing",
    6: "AdamW and Adam, reward (5.3), growth of the loss",
    7: "Measuring pole friction, cart friction and the force curve",
    8: "Friction models, six set-ups",
    9: "Realistic swing-up, recovery after a knock",
    10: "Large pole",
    11: "One agent for both poles",
    12: "One agent for lengths of 0.2 to 1.0 m",
    13: "Perturbed friction coefficients",
    14: "Parameters estimated from transitions",
    15: "Fine-tuning on the cart",
    16: "Recurrent Q-network",
    17: "Outlook: static friction, the pole's vertical force, a learned model",
    18: "Baselines: LQR, PID, energy swing-up",
}
BEYOND = 200  # order from which a study lies beyond the thesis


class Status(StrEnum):
    """How a study stands, in the order of the summary."""

    FAILS = "fails"
    CONTRADICTS = "contradicts the thesis"
    EMPTY = "no result"
    INCOMPLETE = "incomplete"
    OPEN = "not judged"
    ANSWERED = "answered"
    AGREES = "agrees"


VERDICTS = {
    "fails": Status.FAILS,
    "contradicts": Status.CONTRADICTS,
    "agrees": Status.AGREES,
    "answered": Status.ANSWERED,
}


def status(results: StudyResults) -> Status:
    """Return how a study stands: by the verdict that a person wrote about these results, else by themselves.

    Without a verdict a study fails if, in an evaluation that counts, every interquartile mean is below GOOD.
    """
    if not results.agents:
        return Status.EMPTY
    if results.finding:
        return VERDICTS[results.finding.verdict]
    if _all_below(results):
        return Status.FAILS
    return Status.INCOMPLETE if results.missing() or results.exclusions else Status.OPEN


def reason(results: StudyResults) -> str:
    """Return why a study fails where no person wrote it: ": no interquartile mean reaches 2000"."""
    if results.finding or not (failed := _all_below(results)):
        return ""
    place = f" ({', '.join(each.label for each in failed)})" if len(results.evaluations) > 1 else ""
    return f": no interquartile mean reaches {GOOD[results.study.measure]:g}{place}"


def _all_below(results: StudyResults) -> list[Variant]:
    """Return the evaluations that count in which every arm is below GOOD; one of an axis may be hard."""
    good = GOOD.get(results.study.measure)
    if good is None or results.varied:
        return []
    highest = (
        (each, max((found.value for found in estimates(results, each).values()), default=good))
        for each in results.judged
    )
    return [each for each, value in highest if value < good]


def estimates(results: StudyResults, evaluation: Variant) -> dict[str, Estimate]:
    """Return the interquartile mean of each arm (by label) that has agents in an evaluation."""
    found = {arm.label: results.estimate(arm.name, evaluation.name) for arm in results.study.arms}
    return {label: each for label, each in found.items() if each}


def ratios(results: StudyResults) -> dict[str, Estimate]:
    """Return the interquartile mean of each arm's ratio (by label)."""
    if not results.study.ratio:
        return {}
    found = {arm.label: results.ratios(arm.name) for arm in results.study.arms}
    return {label: estimate(values) for label, values in found.items() if values.size}


def answer(results: StudyResults) -> list[str]:
    """Return our answer in a few sentences, the main one first, with intervals and numbers of agents."""
    if not results.agents:
        return ["No result yet."]
    several, shown = len(results.evaluations) > 1, [*results.judged]
    if results.varied and all(each in results.evaluations for each in results.varied):
        shown = [results.varied[0], results.varied[-1]]
    sentences = [
        f"{measure_label(results.study.measure)}{f' ({each.label})' if several else ''}: "
        f"{_extremes(found, results.study.unit)}."
        for each in shown
        if (found := estimates(results, each))
    ]
    if shares := ratios(results):
        first, second = results.evaluations[:2]
        sentences.append(f"Ratio of {second.label} to {first.label}: {_extremes(shares)}.")
    return sentences


def _extremes(found: Mapping[str, Estimate], unit: str = "agent") -> str:
    """Return the estimate of one arm, or of the highest and the lowest of several that differ."""
    ranked = sorted(found, key=lambda label: found[label].value, reverse=True)
    high, low = ranked[0], ranked[-1]
    if len({estimate_text(each) for each in found.values()}) == 1:
        each = "" if len(ranked) == 1 else f"each of {len(ranked)} set-ups "
        return f"{each}{estimate_text(found[high])}, {counted_text(found[high].agents, unit)}"
    return (
        f"highest {estimate_text(found[high])} with {high} ({counted_text(found[high].agents, unit)}), "
        f"lowest {estimate_text(found[low])} with {low} ({counted_text(found[low].agents, unit)})"
    )


def estimate_text(found: Estimate) -> str:
    """Return an estimate with its interval: "4210 ± 85"."""
    return interval_text(found.value, found.low, found.high)


def counted_text(count: int, unit: str = "agent") -> str:
    """Return "1 agent" or "10 agents"."""
    return f"{count} {unit}{'' if count == 1 else 's'}"


def low_is_good(measure: str) -> bool:
    """Return True for a measure of which less is better."""
    return measure.startswith(LOW_IS_GOOD)


def measure_label(measure: str) -> str:
    """Return the name of a measure for axes and tables."""
    return MEASURES.get(measure, measure.replace("_", " ").replace(".", " "))
