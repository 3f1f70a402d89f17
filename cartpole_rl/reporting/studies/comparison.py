"""Two sets of runs, compared group by group."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.reporting.studies.statistics import (
    Estimate,
    difference,
    estimate,
    probability_of_improvement,
)


@dataclass(frozen=True)
class Pair:
    """A group that both sets have. `difference` and `improvement` are of the second over the first."""

    label: str
    first: Estimate
    second: Estimate
    difference: Estimate
    improvement: Estimate


@dataclass(frozen=True)
class Comparison:
    """The common groups of two sets, those of one set alone (set, label), and the settings that differ."""

    names: tuple[str, str]
    pairs: Sequence[Pair]
    lone: Sequence[tuple[str, str]]
    between: Mapping[str, Sequence[str]]


def compare(first: StudyResults, second: StudyResults, between: Mapping[str, Sequence[str]]) -> Comparison:
    """Return the comparison of two sets by the labels of their groups."""
    groups = [
        {
            arm.label: values
            for arm in each.study.arms
            if (values := each.values(arm.name, each.evaluations[0].name)).size
        }
        for each in (first, second)
    ]
    pairs = [
        Pair(
            label,
            estimate(values),
            estimate(others),
            difference(others, values),
            probability_of_improvement(others, values),
        )
        for label, values in groups[0].items()
        if (others := groups[1].get(label)) is not None
    ]
    names = first.study.title, second.study.title
    lone = [(names[0], label) for label in groups[0] if label not in groups[1]]
    lone += [(names[1], label) for label in groups[1] if label not in groups[0]]
    return Comparison(names, pairs, lone, between)
