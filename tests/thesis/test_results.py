"""The results of a study: its verdict, the finding that is bound to them, ratios, and the small JSON file."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from charts import rank_agreements, rank_correlation
from page import answer, robustness, studies_page
from results import Status, as_json, from_json
from scipy import stats
from small_results import CARTS, KNOCKS, Values, found, judged, on_carts, over_knocks

LOW: Values = {"wide": on_carts((4000, 1500), (4000, 1900)), "none": on_carts((4000, 100), (4000, 200))}
HIGH: Values = {name: on_carts((4000, 2500), (4000, 2900)) for name in ("wide", "none")}
COMMENT = {"verdict": "agrees", "comment": "Drawing helps."}


def test_a_swing_up_below_2000_fails_unless_a_person_judged_it() -> None:
    failing = found("one", LOW, evaluations=CARTS)
    assert failing.status() is Status.FAILS
    assert failing.reason() == ": no interquartile mean reaches 2000 (emulated cart)"
    assert judged("one", LOW, COMMENT, evaluations=CARTS).status() is Status.AGREES
    for values, more, status in (
        (LOW, {"measure": "score_upright"}, Status.OPEN),
        ({**LOW, "wide": HIGH["wide"]}, {}, Status.OPEN),
        ({"wide": HIGH["wide"]}, {}, Status.INCOMPLETE),
        ({}, {}, Status.EMPTY),
    ):
        assert found("one", values, evaluations=CARTS, **more).status() is status


def test_a_finding_is_shown_with_complete_results_of_its_size_alone() -> None:
    whole = judged("one", HIGH, {**COMMENT, "verdict": "contradicts"}, evaluations=CARTS)
    assert whole.status() is Status.CONTRADICTS
    assert "Drawing helps." in studies_page([whole], {})
    sizes = {"full": {"seeds": 2}, "quick": {"seeds": 2}}
    smaller = judged("one", HIGH, COMMENT, evaluations=CARTS, sizes=sizes, size="quick")
    partial = judged("one", {"wide": HIGH["wide"]}, COMMENT, evaluations=CARTS)
    for each, expected in ((smaller, Status.OPEN), (partial, Status.INCOMPLETE)):
        assert each.status() is expected
        assert "Drawing helps." not in studies_page([each], {})


def test_a_finding_of_other_numbers_is_not_shown_and_the_page_says_so() -> None:
    zero = {name: on_carts((0, 0), (0, 0)) for name in ("wide", "none")}
    digest = found("one", HIGH, evaluations=CARTS).digest
    finding = {**COMMENT, "size": "full", "digest": digest}
    whole = found("one", zero, evaluations=CARTS, finding=finding)
    assert (whole.status(), whole.finding) == (Status.FAILS, None)
    page = studies_page([whole], {})
    assert "Drawing helps." not in page
    other = f"is about other results (digest {digest}; these have {whole.digest})."
    assert f"The finding in one/study.yaml {other}" in page
    unbound = found("one", HIGH, evaluations=CARTS, finding={**finding, "digest": ""})
    assert unbound.finding is None
    assert "(digest missing; these have" in unbound.remarks[0]


def test_a_digest_depends_on_six_digits_of_each_agent_and_not_on_their_order() -> None:
    def digest(*pairs: tuple[float, float]) -> str:
        return found("one", {"wide": on_carts(*pairs)}, evaluations=CARTS).digest

    first = digest((4000, 2500), (4000, 2900))
    assert first == digest((4000, 2500.0001), (4000, 2900))
    others = digest((4001, 2500), (4000, 2900)), digest((4000, 2500)), digest((4000, 2900), (4000, 2500))
    assert len({first, *others}) == 4
    assert digest((-0.0, 1.0)) == digest((0.0, 1.0))
    whole = found("one", {"wide": on_carts((4000, 2500), (4000, 2900))}, evaluations=CARTS)
    assert replace(whole, agents=whole.agents[::-1]).digest == first


def test_a_finding_is_lost_if_a_single_agent_fails_that_no_interquartile_mean_shows() -> None:
    arms = [{"name": "wide", "label": "drawn"}]
    values = {"wide": on_carts(*[(4000, 4000)] * 10)}
    whole = judged("one", values, COMMENT, evaluations=CARTS, arms=arms)
    assert whole.finding
    *others, last = whole.agents
    failed = replace(whole, agents=(*others, replace(last, values={"simulated": 0.0, "emulated": 0.0})))
    assert whole.estimates("emulated")["drawn"].value == failed.estimates("emulated")["drawn"].value == 4000
    assert failed.finding is None


def test_a_digest_is_that_of_the_small_file() -> None:
    agents = on_carts((1234.49999999, 2500), (1234.5, 0.1234499999999))
    results = found("one", {"wide": agents}, evaluations=CARTS)
    again = from_json(json.loads(json.dumps(as_json(results))), results.study)
    assert again.agents != results.agents
    assert again.digest == results.digest


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda content: content.update(name="../../evil"), "'../../evil' is no name of a study"),
        (lambda content: content.update(format=2), "format 2; this version reads format 1"),
        (lambda content: content["agents"][0]["values"].update(emulated=float("nan")), "nan is no number"),
        (lambda content: content["agents"][0]["values"].update(emulated=True), "True is no number"),
        (lambda content: content["agents"][0].update(arm="moon"), "agent moon/0 is of an arm or evaluation"),
        (lambda content: content["agents"][0].update(values={"moon": 1}), "agent wide/0 is of an arm or"),
        (lambda content: content["agents"].append(content["agents"][0]), "agent wide/0 is there twice"),
    ],
)
def test_damage_in_a_small_file_is_refused(damage: Callable[[Any], object], message: str) -> None:
    results = found("one", LOW, evaluations=CARTS)
    content = json.loads(json.dumps(as_json(results)))
    damage(content)
    with pytest.raises(ValueError, match=re.escape(message)):
        from_json(content, results.study)


def test_each_evaluation_that_a_study_judges_counts() -> None:
    carts = [*CARTS, {"name": "large", "label": "large cart"}]
    agents = [{"simulated": 4000.0, "emulated": 4500.0, "large": 150.0}] * 2
    results = found("one", {"wide": agents, "none": agents}, evaluations=carts, judged=["emulated", "large"])
    assert answer(results) == [
        "Score (6.2) on the emulated cart: each of 2 set-ups 4500 (4500 to 4500), 2 agents.",
        "Score (6.2), large cart: each of 2 set-ups 150 (150 to 150), 2 agents.",
    ]
    assert results.status() is Status.FAILS
    assert results.reason() == ": no interquartile mean reaches 2000 (large cart)"


def test_the_answer_over_an_axis_is_that_at_its_ends() -> None:
    values = {"wide": over_knocks((4000, 3000), (4000, 500)), "none": over_knocks((3000, 0), (3000, 0))}
    first, last = answer(found("knocks", values, evaluations=KNOCKS, axis={"label": "knock"}))
    means = "drawn 4000 (4000 to 4000), not drawn 3000 (3000 to 3000)"
    assert first == f"Score (6.2), knock 0 rad/s: {means}; 2 agents each."
    assert last.startswith("Score (6.2), knock 4 rad/s: drawn 1750 (500 to 3000), not drawn 0 (0 to 0)")


def test_of_many_set_ups_the_answer_has_the_highest_and_the_lowest() -> None:
    arms = [{"name": f"a{number}", "label": f"force {number} N"} for number in range(5)]
    values = {each["name"]: [{"own": float(number)}] * 2 for number, each in enumerate(arms)}
    assert answer(found("one", values, arms=arms, measure="upright_fraction")) == [
        "Share of time upright, 5 set-ups: highest “force 4 N” 4.00 (4.00 to 4.00), "
        "lowest “force 0 N” 0 (0 to 0); 2 agents each."
    ]
    errors = {"wide": [{"own": 0.5}] * 3, "none": [{"own": 0.25}] * 3}
    assert answer(found("one", errors, measure="errors.median", command="identify")) == [
        "Median relative error of the parameters (lower is better): not drawn 0.250 (0.250 to 0.250), "
        "drawn 0.500 (0.500 to 0.500); 3 identifications each."
    ]


def test_agents_that_fail_on_the_first_cart_have_no_ratio() -> None:
    values = {"wide": on_carts((100, 50), (9, 50), (0, 50)), "none": on_carts((10, 20), (10, 10))}
    results = found("one", values, evaluations=CARTS, ratio=True)
    np.testing.assert_allclose(results.ratios("wide"), [0.5])
    np.testing.assert_allclose(results.ratios("none"), [2.0, 1.0])
    assert answer(results)[1].endswith("not drawn 1.50 (1.00 to 2.00) of 2 agents, drawn 0.500 of 1 agent.")


def test_robustness_is_the_mean_share_of_successes_over_criteria() -> None:
    first = {"wide": over_knocks((4000, 3000), (4000, 500)), "none": over_knocks((4000, 0), (100, 0))}
    second = {"wide": over_knocks((4000, 4000), (4000, 4000)), "none": over_knocks((0, 0), (0, 0))}
    criteria = [
        found("robustness_knocks", first, evaluations=KNOCKS, axis={"label": "knock"}),
        found("robustness_mass", second, evaluations=KNOCKS, axis={"label": "mass"}),
    ]
    overall = "overall, 95 % interval"
    assert robustness(criteria) == [
        {"set-up": "drawn", "knock": "75 %", "mass": "100 %", overall: "88 % (75 % to 100 %)", "agents": 2},
        {"set-up": "not drawn", "knock": "25 %", "mass": "0 %", overall: "12 % (0 % to 25 %)", "agents": 2},
    ]
    page = studies_page(
        [*criteria, found("latency", second, evaluations=KNOCKS, axis={"label": "knock"})], {}
    )
    assert "criterion of weight 1/2" in page


def test_a_set_up_that_lacks_agents_has_no_robustness_score() -> None:
    values = {"wide": over_knocks((4000, 4000)), "none": over_knocks((4000, 0), (100, 0))}
    results = found("robustness_knocks", values, evaluations=KNOCKS, axis={"label": "knock"})
    whole, picked = ([*row.values()] for row in robustness([results]))
    assert whole == ["not drawn", "25 %", "25 % (0 % to 50 %)", 2]
    assert picked == ["drawn", "–", "–", 1]


SHARED = on_carts((1, 2), (2, 3), (3, 1), (4, 4))


def test_agents_that_several_studies_share_are_ranked_once() -> None:
    own = [{"name": "wide", "label": "drawn", "overrides": ["run={runs}/one/wide/{seed}"]}]
    own += [{"name": "none", "label": "not drawn"}]
    one = found("one", {"wide": SHARED}, evaluations=CARTS)
    two = found("two", {"wide": SHARED, "none": on_carts((5, 5), (6, 9))}, evaluations=CARTS, arms=own)
    (drawing,) = rank_agreements([one, two])
    assert drawing.caption.startswith("6 agents of 2 studies")
    same = found("one", {"wide": on_carts((0, 0), (0, 0), (1, 2))}, evaluations=CARTS)
    (drawing,) = rank_agreements([same])
    assert drawing.caption.startswith("3 agents of 1 studies")
    assert drawing.answer == "Score (6.2): too few agents for a rank correlation with an interval."
    assert rank_agreements([found("few", {"wide": SHARED[:2]}, evaluations=CARTS)]) == []
    balances = found("three", {"wide": SHARED}, evaluations=CARTS, measure="score_upright")
    assert [each.caption.partition(" ")[0] for each in rank_agreements([same, balances])] == ["3", "4"]
    many = [found(f"n{n}", {"wide": on_carts((n, 2 * n + 1))}, evaluations=CARTS) for n in range(9)]
    assert rank_agreements(many)[0].caption.endswith("Colours do not distinguish the studies.")


@pytest.mark.parametrize(
    ("sign", "noise", "verdict"),
    [
        (1, 0.1, "predicts well"),
        (1, 1.5, "predicts in part"),
        (0, 1, "is not shown to predict"),
        (-1, 0.5, "contradicts"),
    ],
)
def test_the_answer_follows_the_interval_of_the_rank_correlation(
    sign: float, noise: float, verdict: str
) -> None:
    generator = np.random.default_rng(2)
    simulated = generator.normal(size=40)
    emulated = sign * simulated + noise * generator.normal(size=40)
    agents = on_carts(*zip(simulated.tolist(), emulated.tolist(), strict=True))
    (drawing,) = rank_agreements([found("one", {"wide": agents}, evaluations=CARTS)])
    start = f"Score (6.2): the order on the simulated cart {verdict} that on the emulated cart"
    assert drawing.answer.startswith(start)
    assert "over 40 agents the rank correlation is " in drawing.answer


def test_rank_correlation_is_spearmans() -> None:
    values, others = [1.0, 2.0, 2.0, 5.0, 4.0, 9.0], [2.0, 1.0, 4.0, 4.0, 8.0, 7.0]
    rho = rank_correlation(values, others)
    assert rho is not None
    assert rho.low is not None
    assert rho.high is not None
    assert rho.value == pytest.approx(stats.spearmanr(values, others).statistic)
    assert -1 <= rho.low < rho.value < rho.high <= 1
    assert rank_correlation([1.0, 2.0, 3.0], [4.0, 9.0, 20.0]) == (1.0, None, None, 3)
    assert rank_correlation([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]) is None
    assert rank_correlation([1.0], [1.0]) is None
