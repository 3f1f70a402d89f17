"""Builds small results of studies, for the modules of scripts/thesis."""

from typing import Any

from results import StudyResults
from study import Study

from cartpole_rl.checking import validated
from cartpole_rl.reporting.results import Agent

CARTS = [{"name": "simulated", "label": "simulated cart"}, {"name": "emulated", "label": "emulated cart"}]
ARMS = [{"name": "wide", "label": "drawn"}, {"name": "none", "label": "not drawn"}]
Values = dict[str, list[dict[str, float]]]  # of each arm's agents, by evaluation


def a_study(**changes: Any) -> Study:
    """A study of two arms with two seeds each."""
    given = {
        "title": "A study",
        "order": 90,
        "question": "Why?",
        "arms": ARMS,
        "sizes": {"full": {"seeds": 2}},
    }
    return validated(Study, {**given, **changes})


def found(name: str, values: Values, more: dict[str, Any] | None = None, **changes: Any) -> StudyResults:
    """Results with the values of each arm's agents; `more` fields of the results, `changes` of the study."""
    agents = [
        Agent(arm, seed, f"runs/{arm}/{seed}", each)
        for arm, listed in values.items()
        for seed, each in enumerate(listed)
    ]
    return StudyResults.of(name, a_study(**changes), agents, **(more or {}))


def judged(name: str, values: Values, finding: dict[str, str], **changes: Any) -> StudyResults:
    """Results with a finding about them."""
    digest = found(name, values, **changes).digest
    return found(name, values, finding={"size": "full", **finding, "digest": digest}, **changes)


def on_carts(*pairs: tuple[float, float]) -> list[dict[str, float]]:
    """Agents on the simulated and the emulated cart."""
    return [{"simulated": first, "emulated": second} for first, second in pairs]
