"""Figures of groups of agents: colours, guides, and labels that fit their figure."""

import numpy as np
import pytest

from cartpole_rl.drawing.colours import MUTED
from cartpole_rl.reporting.groups import (
    dot_rows,
    drawings,
    palette,
    profile_curves,
    series_colours,
    training_curves,
)
from cartpole_rl.reporting.results import Agent, Group, Results

AGENTS = np.array([400.0, 450.0, 490.0])
LONG = "emulated cart, even spacing / emulated cart, measured spacing"


def test_set_ups_and_evaluations_have_other_colours() -> None:
    arms, evaluations = palette([f"arm {number}" for number in range(6)]), series_colours(["one", "two"])
    assert len({*arms.values(), *evaluations.values()}) == 8


def test_of_many_set_ups_the_first_and_the_last_have_a_colour() -> None:
    labels = [f"arm {number}" for number in range(9)]
    colours = palette(labels, ["arm 4", "arm 0", "arm 8"])
    assert {label for label, colour in colours.items() if colour != MUTED} == {"arm 4", "arm 8"}


def test_all_of_many_set_ups_are_drawn() -> None:
    groups = {f"arm {number}": AGENTS - 10 * number for number in range(9)}
    axes = profile_curves(groups, "score", palette([*groups], [*groups]), "model").axes[0]
    assert sum(len(line.get_xdata()) > 1 for line in axes.lines) == 9
    assert axes.get_ylabel() == "share of models above"


def test_long_labels_of_axes_are_wrapped() -> None:
    axes = dot_rows({"nine": {"": AGENTS}}, LONG).axes[0]
    assert axes.get_xlabel().replace("\n", " ") == LONG
    assert max(map(len, axes.get_xlabel().splitlines())) <= 42


def test_the_text_of_a_guide_stands_over_the_panel() -> None:
    figure = dot_rows({"one": {"": AGENTS}}, "score", {"good: 420": 420.0})
    figure.draw_without_rendering()
    axes = figure.axes[0]
    (text,) = (each for each in axes.texts if each.get_text() == "good: 420")
    assert text.get_window_extent().y0 >= axes.get_window_extent().y1


def test_a_group_label_has_a_band_without_data() -> None:
    axes = dot_rows({"one": {"": AGENTS}, "two": {"": AGENTS}}, "score").axes[0]
    bands = [(patch.get_y(), patch.get_y() + patch.get_height()) for patch in axes.patches]
    heights = [height for line in axes.lines for height in line.get_ydata()]
    assert len(bands) == 2
    assert not any(low <= height <= high for low, high in bands for height in heights)


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


def test_where_less_is_better_there_is_no_profile() -> None:
    agents = [Agent("a", seed, "run", {"own": 0.5}) for seed in range(3)]
    (dots,) = drawings(Results("one", "One", "errors.median", [Group("a", "arm")], tuple(agents)))
    assert dots.caption.endswith("Lower is better.")
