"""Figures of groups of agents: colours, guides, and labels that fit their figure."""

import numpy as np
import pytest

from cartpole_rl.reporting.groups import (
    drawings,
    palette,
    profile_curves,
    training_curves,
)
from cartpole_rl.reporting.results import Agent, Group, Results

AGENTS = np.array([400.0, 450.0, 490.0])


def test_all_of_many_set_ups_are_drawn() -> None:
    groups = {f"arm {number}": AGENTS - 10 * number for number in range(9)}
    axes = profile_curves(groups, "score", palette([*groups], [*groups]), "model").axes[0]
    assert sum(len(line.get_xdata()) > 1 for line in axes.lines) == 9
    assert axes.get_ylabel() == "share of models above"


def test_trainings_of_other_lengths_are_drawn_over_their_share() -> None:
    short = [[(1e5, 1.0), (2e5, 2.0)]]
    for end, label in ((4e6, "share of the training (0.2 to 4 million"), (3e5, "transitions (millions)")):
        groups = {"short": short, "long": [[(1e5, 1.0), (end, 3.0)]]}
        axes = training_curves(groups, "score", palette([*groups])).axes[0]
        assert axes.get_xlabel().replace("\n", " ").startswith(label)
        assert axes.dataLim.x1 == pytest.approx(1.0 if end == 4e6 else 0.3)


def test_of_many_groups_none_is_hidden_and_two_are_coloured() -> None:
    groups = [Group(f"a{number}", f"arm {number}") for number in range(12)]
    agents = [
        Agent(group.name, seed, "run", {"own": 100.0 * number})
        for number, group in enumerate(groups)
        for seed in range(3)
    ]
    dots, profile = drawings(Results("one", "One", "score", groups, tuple(agents)))
    for drawing in (dots, profile):
        assert all(f"arm {number}: " in drawing.alt for number in range(12))
    (legend,) = profile.figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"arm 11", "arm 0"}
    assert "the grey lines are the others" in profile.caption
