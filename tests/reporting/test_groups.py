"""Figures of groups of agents: colours, guides, and labels that fit their figure."""

import numpy as np
import pytest

from cartpole_rl.reporting.groups import dot_rows, drawings, palette, profile_curves, training_curves
from cartpole_rl.reporting.results import Agent, Group, Results, low_is_good
from cartpole_rl.reporting.runs_page import figure_parts

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


def test_of_errors_and_of_endings_before_the_time_less_is_better() -> None:
    names = ("rms_angle_rad", "guarded_fraction", "late_ticks", "ended_by.track", "ended_by.time", "score")
    assert [low_is_good(name) for name in names] == [True] * 4 + [False] * 2
    of_identification = "held_out_1_s.theta_rad", "residual.x_m", "candidates.step.x_m", "parameters.latency"
    assert [low_is_good(name) for name in of_identification] == [True] * 3 + [False]


def results_of(count: int) -> Results:
    """Groups of three agents each, the last one highest."""
    groups = [Group(f"a{number}", f"arm {number}") for number in range(count)]
    agents = [
        Agent(group.name, seed, "run", {"own": 100.0 * number})
        for number, group in enumerate(groups)
        for seed in range(3)
    ]
    return Results("one", "One", "score", groups, tuple(agents))


def test_of_very_many_groups_some_are_shown_and_the_page_says_so() -> None:
    results = results_of(300)
    dots, profile = drawings(results)
    assert "Of 300 groups the 20 highest and the 20 lowest are drawn" in dots.caption
    assert "at most 40 of the 298 others" in profile.caption
    assert sum(len(line.get_xdata()) > 1 for line in profile.figure.axes[0].lines) == 42
    page = "".join(figure_parts(results, (), ()))
    assert "<p>100 groups between them are left out; runs.csv has every run.</p>" in page
    assert page.count("<tr>") == 1 + 200
    assert "left out" not in "".join(figure_parts(results_of(200), (), ()))


def test_few_agents_are_lines_and_many_a_band() -> None:
    curves = [[(1e5, float(seed)), (2e5, 2.0 * seed)] for seed in range(31)]
    for count, lines, bands in ((3, 3 + 1, 0), (31, 1, 1)):
        axes = training_curves({"one": curves[:count]}, "score", palette(["one"])).axes[0]
        assert (len(axes.lines), len(axes.collections)) == (lines, bands)
    assert axes.lines[0].get_ydata().tolist() == [15.0, 30.0]  # the median


def test_of_many_groups_none_is_hidden_and_two_are_coloured() -> None:
    dots, profile = drawings(results_of(12))
    for drawing in (dots, profile):
        assert all(f"arm {number}: " in drawing.alt for number in range(12))
    (legend,) = profile.figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"arm 11", "arm 0"}
    assert "the grey lines are the others" in profile.caption


def test_values_that_are_equal_but_for_rounding_have_a_legible_axis() -> None:
    (axes,) = dot_rows({"a": {"": np.array([4104.2, 4104.2 + 1e-9])}}, "score", {}).axes
    low, high = axes.get_xlim()
    assert low < 4090 < 4110 < high
