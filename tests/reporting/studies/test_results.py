"""What the page derives from the numbers of agents: lines over an axis, robustness, agreement, verdicts."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cartpole_rl.checking import checked
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.answers import Status, answer, opening, reason, status
from cartpole_rl.reporting.studies.figures import drawings
from cartpole_rl.reporting.studies.page import studies_page
from cartpole_rl.reporting.studies.results import Agent, StudyResults, from_json
from cartpole_rl.reporting.studies.robustness import robustness
from cartpole_rl.reporting.studies.sections import drawn
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


def judged(
    name: str, values: dict[str, list[dict[str, float]]], finding: dict[str, str], **changes: Any
) -> StudyResults:
    """Results with a finding about them."""
    digest = results(name, values, **changes).digest
    return results(name, values, finding={**finding, "digest": digest}, **changes)


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
    for each, shares in zip(found, ((1.0, 0.75), (0.25, 0.0)), strict=True):  # of the two agents
        assert each.estimate == (each.overall, min(shares), max(shares), 2)


def test_arms_over_an_axis_form_a_line_for_each_family() -> None:
    arms = [
        {"name": f"{family}_{step}", "label": f"{family}, {step} ms", "value": step}
        for family in ("explicit", "implicit")
        for step in (20, 1)
    ]
    values = {arm["name"]: [{"own": 10.0 * arm["value"]}] for arm in arms}
    (drawing, *_) = drawings(results("integrators", values, arms=arms, axis={"label": "step", "unit": "ms"}))
    assert "over step, ms. explicit: 10.0 at 1, 200 at 20; implicit: 10.0 at 1" in drawn(drawing)
    (axes,) = drawing.figure.axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["1", "20"]


def test_a_swing_up_below_2000_fails_unless_a_person_judged_it() -> None:
    low = {"wide": on_carts((4000, 1500), (4000, 1900)), "none": on_carts((4000, 100), (4000, 200))}
    failing = results("one", low, evaluations=CARTS)
    assert status(failing) is Status.FAILS
    assert reason(failing) == ": no interquartile mean reaches 2000 (emulated cart)"
    finding = {"size": "full", "verdict": "agrees", "comment": "A fall is what it asked for."}
    assert status(judged("one", low, finding, evaluations=CARTS)) is Status.AGREES
    assert status(results("one", low, evaluations=CARTS, measure="score_upright")) is Status.OPEN
    high = {**low, "wide": on_carts((4000, 2500), (4000, 2900))}
    assert status(results("one", high, evaluations=CARTS)) is Status.OPEN
    assert status(results("one", {"wide": high["wide"]}, evaluations=CARTS)) is Status.INCOMPLETE
    assert status(results("one", {}, evaluations=CARTS)) is Status.EMPTY


def test_a_finding_is_shown_with_complete_results_of_its_size_alone() -> None:
    finding = {"size": "full", "verdict": "contradicts", "comment": "Drawing helps."}
    high = {name: on_carts((4000, 2500), (4000, 2900)) for name in ("wide", "none")}
    whole = judged("one", high, finding, evaluations=CARTS)
    assert status(whole) is Status.CONTRADICTS
    assert "Drawing helps." in studies_page([whole], {})
    sizes = {**SIZES, "quick": {"seeds": 2}}
    smaller = judged("one", high, finding, evaluations=CARTS, sizes=sizes, size="quick")
    partial = judged("one", {"wide": high["wide"]}, finding, evaluations=CARTS)
    for each, expected in ((smaller, Status.OPEN), (partial, Status.INCOMPLETE)):
        assert status(each) is expected
        assert "Drawing helps." not in studies_page([each], {})


def test_a_finding_of_other_numbers_is_not_shown_and_the_page_says_so() -> None:
    finding = {"size": "full", "verdict": "agrees", "comment": "Drawing helps."}
    high = {name: on_carts((4000, 2500), (4000, 2900)) for name in ("wide", "none")}
    zero = {name: on_carts((0, 0), (0, 0)) for name in ("wide", "none")}
    digest = results("one", high, evaluations=CARTS).digest
    whole = results("one", zero, evaluations=CARTS, finding={**finding, "digest": digest})
    assert (status(whole), whole.finding) == (Status.FAILS, None)
    page = studies_page([whole], {})
    assert "Drawing helps." not in page
    other = f"is about other results (digest {digest}; these have {whole.digest})."
    assert f"The finding in one/study.yaml {other}" in page
    unbound = results("one", high, evaluations=CARTS, finding=finding)
    assert unbound.finding is None
    assert unbound.remarks == [
        f"The finding in one/study.yaml is about other results (digest missing; these have {digest})."
    ]


def test_a_digest_depends_on_six_digits_of_each_agent_and_not_on_their_order() -> None:
    def digest(*pairs: tuple[float, float]) -> str:
        return results("one", {"wide": on_carts(*pairs)}, evaluations=CARTS).digest

    first = digest((4000, 2500), (4000, 2900))
    assert len(first) == 8
    assert first == digest((4000, 2500.0001), (4000, 2900))
    others = digest((4001, 2500), (4000, 2900)), digest((4000, 2500)), digest((4000, 2900), (4000, 2500))
    assert len({first, *others}) == 4
    assert digest((-0.0, 1.0)) == digest((0.0, 1.0))
    found = results("one", {"wide": on_carts((4000, 2500), (4000, 2900))}, evaluations=CARTS)
    assert replace(found, agents=found.agents[::-1]).digest == first


def test_a_finding_is_lost_if_a_single_agent_fails_that_no_interquartile_mean_shows() -> None:
    finding = {"size": "full", "verdict": "agrees", "comment": "All ten hold the pole."}
    arms = [{"name": "wide", "label": "drawn"}]
    whole = judged("one", {"wide": on_carts(*[(4000, 4000)] * 10)}, finding, evaluations=CARTS, arms=arms)
    assert whole.finding
    *others, last = whole.agents
    failed = replace(whole, agents=(*others, replace(last, values={"simulated": 0.0, "emulated": 0.0})))
    means = [each.estimate("wide", "emulated") for each in (whole, failed)]
    assert [each and each.value for each in means] == [4000, 4000]
    assert failed.finding is None


def test_a_digest_is_that_of_the_small_file() -> None:
    agents = on_carts((1234.49999999, 2500), (1234.5, 0.1234499999999))
    found = results("one", {"wide": agents}, evaluations=CARTS)
    again = from_json(json.loads(json.dumps(found.as_json())), found.study)
    assert again.agents != found.agents
    assert again.digest == found.digest


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content.update(name="../../evil"), "'../../evil' is no name of a study"),
        (lambda content: content["agents"][0]["values"].update(emulated=float("nan")), "nan is no number"),
        (lambda content: content["agents"][0]["values"].update(emulated=True), "True is no number"),
        (lambda content: content["agents"][0].update(arm="moon"), "agent moon/0 is of an arm or evaluation"),
        (lambda content: content["agents"][0].update(values={"moon": 1}), "agent wide/0 is of an arm or"),
        (lambda content: content["agents"].append(content["agents"][0]), "agent wide/0 is there twice"),
    ],
)
def test_damage_in_a_small_file_is_refused(damage: Callable[[Any], object], message: str) -> None:
    found = results("one", {"wide": on_carts((1, 2), (3, 4))}, evaluations=CARTS)
    content = json.loads(json.dumps(found.as_json()))
    damage(content)
    with pytest.raises(ValueError, match=re.escape(message)):
        from_json(content, found.study)


def test_each_evaluation_that_a_study_judges_counts() -> None:
    carts = [*CARTS, {"name": "large", "label": "large cart"}]
    agents = [{"simulated": 4000.0, "emulated": 4500.0, "large": 150.0}] * 2
    found = results("one", {"wide": agents, "none": agents}, evaluations=carts, judged=["emulated", "large"])
    assert answer(found) == [
        "Score (6.2) on the emulated cart: each of 2 set-ups 4500 (4500 to 4500), 2 agents.",
        "Score (6.2), large cart: each of 2 set-ups 150 (150 to 150), 2 agents.",
    ]
    assert status(found) is Status.FAILS
    assert reason(found) == ": no interquartile mean reaches 2000 (large cart)"


def test_a_set_up_that_lacks_agents_has_no_robustness_score() -> None:
    values = {"wide": over_knocks((4000, 4000)), "none": over_knocks((4000, 0), (100, 0))}
    whole, picked = robustness(
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
    means = "drawn 4000 (4000 to 4000), not drawn 3000 (3000 to 3000)"
    assert found[0] == f"Score (6.2), knock 0 rad/s: {means}; 2 agents each."
    assert found[1].startswith("Score (6.2), knock 4 rad/s: drawn 1750 (500 to 3000), not drawn 0 (0 to 0)")


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


def test_the_numbers_of_many_set_ups_are_the_highest_and_the_lowest() -> None:
    arms = [{"name": f"a{number}", "label": f"force {number} N"} for number in range(5)]
    values = {each["name"]: [{"own": float(number)}] * 2 for number, each in enumerate(arms)}
    (numbers,) = answer(results("one", values, arms=arms, measure="upright_fraction"))
    assert numbers == (
        "Share of time upright, 5 set-ups: highest “force 4 N” 4.00 (4.00 to 4.00), "
        "lowest “force 0 N” 0 (0 to 0); 2 agents each."
    )


def test_of_errors_the_lowest_comes_first_and_there_is_no_profile() -> None:
    values = {"wide": [{"own": 0.5}] * 3, "none": [{"own": 0.25}] * 3}
    found = results("one", values, measure="errors.median", command="identify")
    assert answer(found) == [
        "Median relative error of the parameters (lower is better): not drawn 0.250 (0.250 to 0.250), "
        "drawn 0.500 (0.500 to 0.500); 3 identifications each."
    ]
    (drawing,) = drawings(found)
    assert drawing.caption.endswith("Lower is better.")


def test_agents_without_ratio_are_counted() -> None:
    values = {"wide": on_carts((100, 50), (9, 50)), "none": on_carts((100, 20), (100, 30))}
    *_, ratio = answer(results("one", values, evaluations=CARTS, ratio=True))
    assert ratio.endswith("drawn 0.500 of 1 agent, not drawn 0.250 (0.200 to 0.300) of 2 agents.")


def test_a_summary_shows_the_first_sentences() -> None:
    long = f"It is {'very ' * 40}good."
    assert opening(f"Yes. {long} So it is.") == f"Yes. {long}"
    assert (
        opening(f"The order does not matter at all here. {long}") == "The order does not matter at all here."
    )
    assert (
        opening("It is 0.5 of (5.3). Both fall. Neither rises.")
        == "It is 0.5 of (5.3). Both fall. Neither rises."
    )


def test_of_many_set_ups_none_is_hidden_and_two_are_coloured() -> None:
    arms = [{"name": f"a{number}", "label": f"arm {number}"} for number in range(12)]
    values = {each["name"]: [{"own": 100.0 * number}] * 3 for number, each in enumerate(arms)}
    dots, profile = drawings(results("one", values, arms=arms))
    for drawing in (dots, profile):
        assert all(f"arm {number}: " in drawing.alt for number in range(12))
    (legend,) = profile.figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"arm 11", "arm 0"}
    assert "the grey lines are the others" in profile.caption


def test_a_set_up_has_one_colour_in_all_figures() -> None:
    curve = {"score": ((1e5, 10.0), (2e5, 20.0))}
    agents = tuple(
        Agent(arm, seed, "run", {"own": value + seed}, curve if arm == "none" else {})
        for arm, value in (("wide", 10.0), ("none", 30.0))
        for seed in range(3)
    )
    dots, profile, training = (each.figure.axes[0] for each in drawings(StudyResults("one", study(), agents)))
    thick = [max(axes.lines, key=lambda line: line.get_linewidth()) for axes in (profile, training)]
    assert profile.lines[1].get_color() == thick[1].get_color() == dots.lines[-1].get_color()


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
