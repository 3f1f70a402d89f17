"""Does the order of agents in simulation predict that on the cart? One figure and one sentence per score."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from cartpole_rl.reporting.figures.studies import agreement
from cartpole_rl.reporting.studies.figures import FEWEST_PROFILED, Array, Drawing, one_colour
from cartpole_rl.reporting.studies.numbers import SCORES, measure_label, sentence_start
from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.reporting.studies.settings import Variant
from cartpole_rl.reporting.studies.statistics import rank_correlation

CLEAR = 0.8  # rank correlation from which an order predicts the other well


def rank_agreements(results: Sequence[StudyResults]) -> list[Drawing]:
    """Return the agreement of the agents' order in simulation and on the cart, for each score."""
    found = (_rank_agreement(results, measure) for measure in SCORES)
    return [each for each in found if each]


def _rank_agreement(results: Sequence[StudyResults], measure: str) -> Drawing | None:
    """Return the `measure` of all agents in the two evaluations that most studies compare; None for too few.

    Only studies of this measure count.
    """
    compared = [
        each
        for each in results
        if len(each.evaluations) > 1 and each.study.measure == measure and not each.varied
    ]
    names = Counter(_first_two(each) for each in compared)
    if not names:
        return None
    common, _ = names.most_common(1)[0]
    same = [each for each in compared if _first_two(each) == common]
    groups = _pairs_by_study(same)
    agents = sum(each.shape[1] for each in groups.values())
    if agents < FEWEST_PROFILED:
        return None
    first, second = same[-1].evaluations[:2]
    label = measure_label(measure)
    figure = agreement(groups, f"{label}, {first.label}", f"{label}, {second.label}")
    return Drawing(
        f"rank_agreement_{measure}",
        figure,
        f"{label} of {agents} agents of {len(groups)} studies: {second.label} over {first.label}.",
        f"{agents} agents of {len(groups)} studies. The dashed line: the same {label} on both. "
        f"The simulated cart is the nominal one of each agent's training.{one_colour(groups, 'studies')}",
        _verdict(groups, label, first, second),
    )


def _first_two(results: StudyResults) -> tuple[str, str]:
    return results.evaluations[0].name, results.evaluations[1].name


def _pairs_by_study(results: Sequence[StudyResults]) -> dict[str, Array]:
    """Return the pairs [2, agents] of each study's title; an agent of several studies counts once."""
    known: set[str] = set()
    groups: dict[str, Array] = {}
    for each in results:
        first, second = _first_two(each)
        compared = {
            each.identity(agent): (agent.values[first], agent.values[second])
            for agent in each.agents
            if {first, second} <= agent.values.keys()
        }
        fresh = [pair for name, pair in compared.items() if name not in known]
        known |= compared.keys()
        if fresh:
            title = each.study.title
            groups[title if title not in groups else f"{title} ({each.name})"] = np.array(fresh).T
    return groups


def _verdict(groups: dict[str, Array], label: str, first: Variant, second: Variant) -> str:
    """Return in one sentence how far the order on the first cart predicts that on the second."""
    found = rank_correlation(*np.concatenate([*groups.values()], axis=1))
    if found is None or found.low is None or found.high is None:
        return f"{sentence_start(label)}: too few agents for a rank correlation with an interval."
    if found.low <= 0 <= found.high:
        word = "is not shown to predict"
    elif found.value < 0:
        word = "contradicts"
    else:
        word = "predicts well" if found.value >= CLEAR else "predicts in part"
    return (
        f"{sentence_start(label)}: the order on the {first.label} {word} that on the {second.label}; over "
        f"{found.agents} agents the rank correlation is {found.value:.2f} (95 % interval {found.low:.2f} to "
        f"{found.high:.2f}; 1: the same order, 0: no relation)."
    )
