"""The checks of the machines that offer a learner."""

import time
from typing import Any

import pytest

from cartpole_rl.errors import LearnerError
from cartpole_rl.workflows.ray_learner.node import check_learners, fact_finder

NODES = [
    {"NodeID": "gone", "Alive": False, "Resources": {"learner": 1}, "NodeManagerAddress": "10.0.0.1"},
    {"NodeID": "cart", "Alive": True, "Resources": {"cart_1": 1}, "NodeManagerAddress": "10.0.0.2"},
    {"NodeID": "server", "Alive": True, "Resources": {"learner": 1}, "NodeManagerAddress": "10.0.0.3"},
]


def facts(clock: float = 0.0, **versions: str | None) -> dict[str, Any]:
    """The facts of this machine with a clock that is `clock` s ahead, and other `versions`."""
    own = fact_finder()()
    return {"versions": {**own["versions"], **versions}, "clock": time.time() + clock}


def test_the_same_versions_and_clocks_are_accepted() -> None:
    asked = []
    assert check_learners(NODES, lambda node: asked.append(node) or facts()) == []
    assert asked == ["server"]


def test_another_version_is_refused() -> None:
    text = (
        "other versions: torch .* here and 1.0 there, tensordict .* here and missing there; install the same"
    )
    with pytest.raises(LearnerError, match=text):
        check_learners(NODES, lambda _: facts(torch="1.0", tensordict=None))


@pytest.mark.parametrize(("ahead", "warnings"), [(-60.0, 1), (-2.0, 0), (2.0, 0), (60.0, 1)])
def test_clocks_that_differ_are_reported(ahead: float, warnings: int) -> None:
    found = check_learners(NODES, lambda _: facts(ahead))
    assert len(found) == warnings
    assert all("10.0.0.3 differs by 60 s" in text for text in found)


def test_a_cluster_without_a_learner_is_refused() -> None:
    with pytest.raises(LearnerError, match=r"no Ray node offers the resource learner: .* ray start --head"):
        check_learners(NODES[:2], lambda _: facts())
