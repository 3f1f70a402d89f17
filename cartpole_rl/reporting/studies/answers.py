"""Our answer to a study in words, and how it stands: what fails or contradicts comes first on the page."""

import re
from collections.abc import Mapping
from enum import StrEnum

from cartpole_rl.reporting.studies.numbers import (
    counted_text,
    estimate_text,
    low_is_good,
    measure_label,
    sentence_start,
)
from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.reporting.studies.settings import Variant
from cartpole_rl.reporting.studies.statistics import Estimate, estimate

GOOD = {"score": 2000.0}  # measure: value above which the thesis calls an agent good (section 6)
THESIS_ROWS = {  # of the thesis's list: what must work
    1: "Physics, both integrators, substeps",
    2: "Balance with reward (5.1), three actions",
    3: "Balance with a reward for angle and position",
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
CARTS = ("simulated cart", "emulated cart")  # starts of labels of evaluations
MOST_LISTED = 4  # set-ups in a sentence; of more, the highest and the lowest
PLAIN = re.compile(r"[A-Za-z' -]+")  # labels that need no quotation marks
SENTENCES = re.compile(r"(?<=[a-z0-9)][.?!]) (?=[A-Z])")
OPENING, SHORT = 200, 30  # characters of a text's first sentences: at most; fewer take another sentence


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
    """Return our numbers in a few sentences, the main one first, with intervals and numbers of agents."""
    if not results.agents:
        return ["No result yet."]
    study, shown = results.study, [*results.judged]
    if results.varied and all(each in results.evaluations for each in results.varied):
        shown = [results.varied[0], results.varied[-1]]
    name = sentence_start(measure_label(study.measure))
    sentences = [
        f"{name}{_place(results, each)}{_ranked(found, study.unit, study.measure)}."
        for each in shown
        if (found := estimates(results, each))
    ]
    if shares := ratios(results):
        first, second = results.evaluations[:2]
        sentences.append(f"Ratio of {second.label} to {first.label}{_ranked(shares)}.")
    return sentences


def _place(results: StudyResults, evaluation: Variant) -> str:
    """Return where a number was measured: " on the emulated cart", ", latency 60 ms"; empty for one place."""
    if len(results.evaluations) == 1:
        return ""
    if evaluation.value is not None and results.study.axis:
        return f", {results.study.axis.label} {evaluation.label}"
    if evaluation.label.startswith(CARTS):
        return f" on the {evaluation.label}"
    return f", {evaluation.label}"


def _ranked(found: Mapping[str, Estimate], unit: str = "agent", measure: str = "") -> str:
    """Return ": " and the estimate of each arm, the best first; of many the highest and the lowest."""
    less = low_is_good(measure)
    note = " (lower is better)" if less else ""
    labels = sorted(found, key=lambda label: found[label].value, reverse=not less)
    best = found[labels[0]]
    same_count = all(each.agents == best.agents for each in found.values())
    if same_count and len({estimate_text(each, measure) for each in found.values()}) == 1:
        each = "" if len(labels) == 1 else f"each of {len(labels)} set-ups "
        return f"{note}: {each}{estimate_text(best, measure)}, {counted_text(best.agents, unit)}"

    def entry(label: str) -> str:
        count = "" if same_count else f" of {counted_text(found[label].agents, unit)}"
        return f"{_quoted(label)} {estimate_text(found[label], measure)}{count}"

    end = f"; {counted_text(best.agents, unit)} each" if same_count else ""
    first, last = ("lowest", "highest") if less else ("highest", "lowest")
    if len(labels) <= MOST_LISTED:
        return f"{note}: {', '.join(map(entry, labels))}{end}"
    return f"{note}, {len(labels)} set-ups: {first} {entry(labels[0])}, {last} {entry(labels[-1])}{end}"


def _quoted(label: str) -> str:
    """Return a label, in quotation marks where it would run into the number that follows it."""
    return label if PLAIN.fullmatch(label) else f"“{label}”"


def opening(text: str) -> str:
    """Return the first sentence of a text, and the next ones up to OPENING characters."""
    first, *others = SENTENCES.split(text)
    for sentence in others:
        if len(first) >= SHORT and len(first) + len(sentence) > OPENING:
            break
        first += f" {sentence}"
    return first
