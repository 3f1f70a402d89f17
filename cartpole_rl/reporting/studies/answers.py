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
    AGREES = "agrees"


VERDICTS = {"fails": Status.FAILS, "contradicts": Status.CONTRADICTS, "agrees": Status.AGREES}


def status(results: StudyResults) -> Status:
    """Return how a study stands: by its results, then by the verdict that a person wrote.

    Without a verdict a study fails if the interquartile mean of every arm is below GOOD.
    """
    if not results.agents:
        return Status.EMPTY
    if results.study.verdict in ("fails", "contradicts"):
        return VERDICTS[results.study.verdict]
    if not results.study.verdict and _all_below(results):
        return Status.FAILS
    if results.missing() or results.exclusions:
        return Status.INCOMPLETE
    return VERDICTS.get(results.study.verdict, Status.OPEN)


def reason(results: StudyResults) -> str:
    """Return why a study fails where no person wrote it: ": no interquartile mean reaches 2000"."""
    if results.study.verdict or not _all_below(results):
        return ""
    return f": no interquartile mean reaches {GOOD[results.study.measure]:g}"


def _all_below(results: StudyResults) -> bool:
    """Return True if every arm is below GOOD in the evaluation that counts; one of an axis may be hard."""
    good = GOOD.get(results.study.measure)
    found = [each.value for each in estimates(results, results.judged).values()]
    return good is not None and not results.varied and bool(found) and max(found) < good


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
    several, shown = len(results.evaluations) > 1, [results.judged]
    if results.varied and {*results.varied} <= {*results.evaluations}:
        shown = [results.varied[0], results.varied[-1]]
    sentences = [
        f"{measure_label(results.study.measure)}{f' ({each.label})' if several else ''}: {_extremes(found)}."
        for each in shown
        if (found := estimates(results, each))
    ]
    if shares := ratios(results):
        first, second = results.evaluations[:2]
        sentences.append(f"Ratio of {second.label} to {first.label}: {_extremes(shares)}.")
    return sentences


def _extremes(found: Mapping[str, Estimate]) -> str:
    """Return the estimate of one arm, or of the highest and the lowest of several."""
    ranked = sorted(found, key=lambda label: found[label].value, reverse=True)
    if len(ranked) == 1:
        return f"{estimate_text(found[ranked[0]])}, {agents_text(found[ranked[0]].agents)}"
    high, low = ranked[0], ranked[-1]
    return (
        f"highest {estimate_text(found[high])} with {high} ({agents_text(found[high].agents)}), "
        f"lowest {estimate_text(found[low])} with {low} ({agents_text(found[low].agents)})"
    )


def estimate_text(found: Estimate) -> str:
    """Return an estimate with its interval: "4210 ± 85"."""
    return interval_text(found.value, found.low, found.high)


def agents_text(count: int) -> str:
    """Return "1 agent" or "10 agents"."""
    return f"{count} agent{'' if count == 1 else 's'}"


def low_is_good(measure: str) -> bool:
    """Return True for a measure of which less is better."""
    return measure.startswith(LOW_IS_GOOD)


def measure_label(measure: str) -> str:
    """Return the name of a measure for axes and tables."""
    return MEASURES.get(measure, measure.replace("_", " ").replace(".", " "))
