"""What the page derives from the numbers of agents: lines over an axis, robustness, agreement, verdicts."""

from typing import Any

import numpy as np
import pytest

from cartpole_rl.checking import checked
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.answers import Status, answer, low_is_good, reason, status
from cartpole_rl.reporting.studies.figures import drawings, rank_agreements
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
    (drawing,) = rank_agreements([one, two])
    assert drawing.caption.startswith("6 agents of 2 studies")
    assert rank_agreements([results("few", {"wide": shared[:2]}, evaluations=CARTS)]) == []


def test_agents_of_each_score_are_ranked_among_themselves() -> None:
    swings = results("one", {"wide": on_carts((1, 2), (2, 3), (3, 1))}, evaluations=CARTS)
    balances = results(
        "two", {"wide": on_carts((5, 5), (6, 9), (7, 8), (8, 9))}, evaluations=CARTS, measure="score_upright"
    )
    assert [each.caption.partition(" ")[0] for each in rank_agreements([swings, balances])] == ["3", "4"]


def test_a_swing_up_below_2000_fails_unless_a_person_judged_it() -> None:
    low = {"wide": on_carts((4000, 1500), (4000, 1900)), "none": on_carts((4000, 100), (4000, 200))}
    failing = results("one", low, evaluations=CARTS)
    assert status(failing) is Status.FAILS
    assert reason(failing) == ": no interquartile mean reaches 2000 (emulated cart)"
    finding = {"size": "full", "verdict": "agrees", "comment": "A fall is what it asked for."}
    assert status(results("one", low, evaluations=CARTS, finding=finding)) is Status.AGREES
    assert status(results("one", low, evaluations=CARTS, measure="score_upright")) is Status.OPEN
    high = {**low, "wide": on_carts((4000, 2500), (4000, 2900))}
    assert status(results("one", high, evaluations=CARTS)) is Status.OPEN
    assert status(results("one", {"wide": high["wide"]}, evaluations=CARTS)) is Status.INCOMPLETE
    assert status(results("one", {}, evaluations=CARTS)) is Status.EMPTY


def test_a_finding_is_shown_with_complete_results_of_its_size_alone() -> None:
    finding = {"size": "full", "verdict": "contradicts", "comment": "Drawing helps."}
    high = {name: on_carts((4000, 2500), (4000, 2900)) for name in ("wide", "none")}
    whole = results("one", high, evaluations=CARTS, finding=finding)
    assert status(whole) is Status.CONTRADICTS
    assert "Drawing helps." in studies_page([whole], {})
    sizes = {**SIZES, "quick": {"seeds": 2}}
    smaller = results("one", high, evaluations=CARTS, finding=finding, sizes=sizes, size="quick")
    partial = results("one", {"wide": high["wide"]}, evaluations=CARTS, finding=finding)
    for each, expected in ((smaller, Status.OPEN), (partial, Status.INCOMPLETE)):
        assert status(each) is expected
        assert "Drawing helps." not in studies_page([each], {})


def test_each_evaluation_that_a_study_judges_counts() -> None:
    carts = [*CARTS, {"name": "large", "label": "large cart"}]
    agents = [{"simulated": 4000.0, "emulated": 4500.0, "large": 150.0}] * 2
    found = results("one", {"wide": agents, "none": agents}, evaluations=carts, judged=["emulated", "large"])
    assert answer(found) == [
        "score (6.2) (emulated cart): each of 2 set-ups 4500 ± 0, 2 agents.",
        "score (6.2) (large cart): each of 2 set-ups 150 ± 0, 2 agents.",
    ]
    assert status(found) is Status.FAILS
    assert reason(found) == ": no interquartile mean reaches 2000 (large cart)"


def test_a_set_up_that_lacks_agents_has_no_robustness_score() -> None:
    values = {"wide": over_knocks((4000, 4000)), "none": over_knocks((4000, 0), (100, 0))}
    (whole, picked) = robustness(
        [results("robustness_knocks", values, evaluations=KNOCKS, axis={"label": "knock"})]
    )
    assert (whole.label, whole.overall, whole.agents) == ("not drawn", 0.25, 2)
    assert (picked.label, picked.overall, picked.agents) == ("drawn", None, 1)


def test_an_evaluation_has_its_own_episodes_and_those_of_an_arm() -> None:
    common = ("episodes=10",)
    words = {"overrides": ["randomization=wide", "episodes=100"], "of_arms": {"wide": ["plant.substeps=1"]}}
    wide, plain = study(evaluations=[{**CARTS[0], **words}, CARTS[1]]).evaluations
    assert wide.words("wide", common) == ("randomization=wide", "episodes=100", "plant.substeps=1")
    assert wide.words("none", common) == ("randomization=wide", "episodes=100")
    assert plain.words("wide", common) == common


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


def test_each_curve_of_the_trainings_is_drawn() -> None:
    curves = {"score_upright": ((1e5, 10.0), (2e5, 20.0)), "loss": ((1e5, 0.1), (2e5, 0.5))}
    agents = tuple(Agent("wide", seed, "run", {"own": 20.0}, curves) for seed in (0, 1))
    captions = [drawing.caption for drawing in drawings(StudyResults("one", study(), agents))]
    drawn = [text.split(".")[0] for text in captions if text.startswith("Training: ")]
    assert drawn == ["Training: score (6", "Training: loss"]


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
        (
            {"finding": {"size": "huge", "verdict": "agrees", "comment": "So."}},
            "finding.size: huge is not in sizes",
        ),
        ({"judged": ["moon"], "evaluations": CARTS}, "judged: moon is unknown; give some of simulated,"),
        (
            {"evaluations": [{**CARTS[0], "of_arms": {"half": []}}]},
            "of_arms: half is unknown; give some of wide, none",
        ),
        ({"arms": [{"name": "../a", "label": "a"}]}, "arms.0.name"),
        ({"command": "swim"}, "command=swim: give 'train'"),
    ],
)
def test_a_study_that_cannot_be_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        study(**changes)
