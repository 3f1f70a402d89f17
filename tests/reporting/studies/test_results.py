"""What the page derives from the numbers of agents: lines over an axis, robustness, agreement, verdicts."""

from typing import Any

import numpy as np
import pytest

from cartpole_rl.checking import checked
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.answers import Status, answer, low_is_good, reason, status
from cartpole_rl.reporting.studies.figures import drawings, rank_agreement
from cartpole_rl.reporting.studies.page import studies_page
from cartpole_rl.reporting.studies.results import Agent, StudyResults
from cartpole_rl.reporting.studies.robustness import robustness
from cartpole_rl.reporting.studies.settings import Study

SIZES = {"full": {"seeds": 2}}
CARTS = [{"name": "simulated", "label": "simulated cart"}, {"name": "emulated", "label": "emulated cart"}]
KNOCKS = [{"name": f"knock_{value}", "label": f"{value} rad/s", "value": value} for value in (0, 4)]


def study(**changes: Any) -> Study:
    arms = [{"name": "wide", "label": "drawn"}, {"name": "none", "label": "not drawn"}]
    return checked(
        Study,
        {"title": "A study", "order": 90, "question": "Why?", "arms": arms, "sizes": SIZES, **changes},
    )


def results(name: str, values: dict[str, list[dict[str, float]]], **changes: Any) -> StudyResults:
    """Results with the values of each arm's agents, by evaluation."""
    agents = [
        Agent(arm, seed, f"runs/{arm}/{seed}", each)
        for arm, listed in values.items()
        for seed, each in enumerate(listed)
    ]
    return StudyResults(name, study(**changes), tuple(agents))


def on_carts(*pairs: tuple[float, float]) -> list[dict[str, float]]:
    return [{"simulated": first, "emulated": second} for first, second in pairs]


def over_knocks(*pairs: tuple[float, float]) -> list[dict[str, float]]:
    return [{"knock_0": first, "knock_4": second} for first, second in pairs]


def test_robustness_is_the_mean_share_of_successes_over_criteria() -> None:
    axis = {"label": "knock"}
    first = {"wide": over_knocks((4000, 3000), (4000, 500)), "none": over_knocks((4000, 0), (100, 0))}
    second = {"wide": over_knocks((4000, 4000), (4000, 4000)), "none": over_knocks((0, 0), (0, 0))}
    found = robustness(
        [
            results("robustness_knocks", first, evaluations=KNOCKS, axis=axis),
            results("robustness_mass", second, evaluations=KNOCKS, axis={"label": "mass"}),
            results("latency", second, evaluations=KNOCKS, axis=axis),
        ]
    )
    assert [(each.label, dict(each.criteria), each.overall) for each in found] == [
        ("drawn", {"knock": 0.75, "mass": 1.0}, 0.875),
        ("not drawn", {"knock": 0.25, "mass": 0.0}, 0.125),
    ]


def test_arms_over_an_axis_form_a_line_for_each_family() -> None:
    arms = [
        {"name": f"{family}_{step}", "label": f"{family}, {step} ms", "value": step}
        for family in ("explicit", "implicit")
        for step in (20, 1)
    ]
    values = {arm["name"]: [{"own": 10.0 * arm["value"]}] for arm in arms}
    (drawing, *_) = drawings(results("integrators", values, arms=arms, axis={"label": "step", "unit": "ms"}))
    assert "over step, ms. explicit: 10.0 at 1, 200 at 20; implicit: 10.0 at 1" in drawing.svg


def test_agents_that_several_studies_share_agree_once() -> None:
    shared = on_carts((1, 2), (2, 3), (3, 1), (4, 4))
    own = on_carts((5, 5), (6, 9))
    one = results("one", {"wide": shared}, evaluations=CARTS)
    two = results("two", {"wide": shared, "none": own}, evaluations=CARTS)
    drawing = rank_agreement([one, two])
    assert drawing is not None
    assert drawing.caption.startswith("6 agents of 2 studies")
    assert rank_agreement([results("few", {"wide": shared[:2]}, evaluations=CARTS)]) is None


def test_a_swing_up_below_2000_fails_unless_a_person_judged_it() -> None:
    low = {"wide": on_carts((4000, 1500), (4000, 1900)), "none": on_carts((4000, 100), (4000, 200))}
    failing = results("one", low, evaluations=CARTS)
    assert status(failing) is Status.FAILS
    assert reason(failing) == ": no interquartile mean reaches 2000"
    assert status(results("one", low, evaluations=CARTS, verdict="agrees")) is Status.AGREES
    assert status(results("one", low, evaluations=CARTS, measure="score_upright")) is Status.OPEN
    high = {**low, "wide": on_carts((4000, 2500), (4000, 2900))}
    assert status(results("one", high, evaluations=CARTS)) is Status.OPEN
    assert status(results("one", {"wide": high["wide"]}, evaluations=CARTS)) is Status.INCOMPLETE
    assert status(results("one", {}, evaluations=CARTS)) is Status.EMPTY


def test_the_answer_over_an_axis_is_that_at_its_ends() -> None:
    values = {"wide": over_knocks((4000, 3000), (4000, 500)), "none": over_knocks((3000, 0), (3000, 0))}
    found = answer(results("knocks", values, evaluations=KNOCKS, axis={"label": "knock"}))
    assert len(found) == 2
    assert found[0].startswith("score (6.2) (0 rad/s): highest 4000")
    assert found[1].startswith("score (6.2) (4 rad/s): highest 1750")


def test_ratios_leave_out_agents_that_fail_on_the_first_cart() -> None:
    values = {"wide": on_carts((100, 50), (9, 50), (0, 50)), "none": on_carts((10, 20), (10, 10))}
    found = results("one", values, evaluations=CARTS, ratio=True)
    np.testing.assert_allclose(found.ratios("wide"), [0.5])
    np.testing.assert_allclose(found.ratios("none"), [2.0, 1.0])


def test_curves_of_loss_are_drawn_where_a_study_asks_for_them() -> None:
    curves = {"score": ((1e5, 10.0), (2e5, 20.0)), "loss": ((1e5, 0.1), (2e5, 0.5))}
    agents = tuple(Agent("wide", seed, "run", {"own": 20.0}, curves) for seed in (0, 1))
    captions = [
        drawing.caption for drawing in drawings(StudyResults("one", study(curves=["score", "loss"]), agents))
    ]
    assert [text for text in captions if text.startswith("Training: loss")]
    captions = [drawing.caption for drawing in drawings(StudyResults("one", study(), agents))]
    assert not [text for text in captions if text.startswith("Training: loss")]


def test_a_study_without_results_is_on_the_page() -> None:
    page = studies_page([results("one", {})], {})
    assert "No result yet." in page
    assert "no result" in page


def test_less_is_better_of_errors_and_times() -> None:
    assert low_is_good("errors.median")
    assert low_is_good("time_to_upright_s")
    assert not low_is_good("score")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ratio": True}, "ratio=true needs two evaluations"),
        ({"arms": [{"name": "a", "label": "a"}] * 2}, "arms: a is there more than once"),
        ({"arms": [{"name": name, "label": "same"} for name in "ab"]}, "arms: same is there more than once"),
        ({"size": "huge"}, "size: huge is not in sizes"),
        ({"arms": [{"name": "../a", "label": "a"}]}, "arms.0.name"),
        ({"command": "swim"}, "command=swim: give 'train'"),
    ],
)
def test_a_study_that_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        study(**changes)
