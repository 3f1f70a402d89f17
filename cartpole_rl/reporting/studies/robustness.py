"""One robustness score, in the manner of the leaderboard of DFKI's double pendulum (Wiebe et al., 2023).

Each study whose name starts with CRITERIA is one criterion: a quantity of the cart is set to several values.
Its score is the share of successful cases, a case being one agent at one value and a success a score above
GOOD. All criteria have the same weight.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cartpole_rl.reporting.studies.answers import GOOD
from cartpole_rl.reporting.studies.results import Array, StudyResults
from cartpole_rl.reporting.studies.statistics import Estimate, mean_estimate

CRITERIA = "robustness_"  # prefix of the names of studies


@dataclass(frozen=True)
class Robustness:
    """The score of one set-up: by criterion, and their mean; None where a criterion lacks agents.

    `agents` is the smallest number of agents of any case, `estimate` the overall score with the interval of
    the mean over agents; None where criteria have other numbers of agents.
    """

    label: str
    criteria: Mapping[str, float | None]
    agents: int
    estimate: Estimate | None = None

    @property
    def overall(self) -> float | None:
        """The mean of the criteria; None if one is missing."""
        present = [score for score in self.criteria.values() if score is not None]
        return float(np.mean(present)) if len(present) == len(self.criteria) else None


def robustness(results: Sequence[StudyResults]) -> list[Robustness]:
    """Return the scores of the set-ups of all criteria, the most robust first; none without results."""
    criteria = [
        each
        for each in results
        if each.name.startswith(CRITERIA) and each.agents and each.varied and each.study.measure in GOOD
    ]
    labels = dict.fromkeys(arm.label for each in criteria for arm in each.study.arms)
    found = [
        Robustness(
            label,
            {_quantity(each): _share(each, label) for each in criteria},
            min(values.size for each in criteria for values in _cases(each, label)),
            _estimate(criteria, label),
        )
        for label in labels
    ]
    return sorted(found, key=lambda each: -1.0 if each.overall is None else each.overall, reverse=True)


def _share(results: StudyResults, label: str) -> float | None:
    """Return the share of successful cases of a set-up, each value of the quantity with the same weight.

    It is None if a value has fewer agents than the study asks for: agents must not be picked.
    """
    values, asked = _cases(results, label), results.size.seeds if results.size else 1
    if any(each.size < asked for each in values):
        return None
    return float(np.mean([(each > GOOD[results.study.measure]).mean() for each in values]))


def _estimate(criteria: Sequence[StudyResults], label: str) -> Estimate | None:
    """Return the mean over agents of their shares of successful cases, each criterion with equal weight.

    The agents of a set-up are the same in all criteria, so that whole agents are resampled.
    """
    counts = {values.size for each in criteria for values in _cases(each, label)}
    if len(counts) != 1 or 0 in counts or any(_share(each, label) is None for each in criteria):
        return None
    shares = [
        np.mean([values > GOOD[each.study.measure] for values in _cases(each, label)], axis=0)
        for each in criteria
    ]
    return mean_estimate(np.mean(shares, axis=0))


def _cases(results: StudyResults, label: str) -> list[Array]:
    """Return the measures of a set-up's agents [agents] at each value of the quantity."""
    arm = next((arm.name for arm in results.study.arms if arm.label == label), "")
    return [results.values(arm, evaluation.name) for evaluation in results.varied]


def _quantity(results: StudyResults) -> str:
    assert results.study.axis
    return results.study.axis.label
