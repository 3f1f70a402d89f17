"""The results of a study: its verdict, the finding that is bound to them, ratios, and the small JSON file."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from charts import rank_agreements, rank_correlation
from page import answer, robustness, studies_page
from results import Status, as_json, from_json
from scipy import stats
from small_results import CARTS, KNOCKS, Values, found, judged, on_carts, over_knocks

LOW: Values = {"wide": on_carts((4000, 1500), (4000, 1900)), "none": on_carts((4000, 100), (4000, 200))}
HIGH: Values = {name: on_carts((4000, 2500), (4000, 2900)) for name in ("wide", "none")}
ZERO: Values = {name: on_carts((0, 0), (0, 0)) for name in ("wide", "none")}
AGREES = {"size": "full", "verdict": "agrees", "comment": "Drawing helps."}


def test_a_swing_up_below_2000_fails_unless_a_person_judged_it() -> None:
    assert (
        found("one", LOW, evaluations=CARTS).reason()
        == ": no interquartile mean reaches 2000 (emulated cart)"
    )
    assert judged("one", LOW, AGREES, evaluations=CARTS).status() is Status.AGREES
    for values, more, status in (
        (LOW, {}, Status.FAILS),
        (LOW, {"measure": "score_upright"}, Status.OPEN),
        ({**LOW, "wide": HIGH["wide"]}, {}, Status.OPEN),
        ({"wide": HIGH["wide"]}, {}, Status.INCOMPLETE),
        ({}, {}, Status.EMPTY),
    ):
        assert found("one", values, evaluations=CARTS, **more).status() is status


def test_a_finding_is_shown_with_complete_results_of_its_size_and_digest_alone() -> None:
    whole = judged("one", HIGH, {**AGREES, "verdict": "contradicts"}, evaluations=CARTS)
    assert whole.status() is Status.CONTRADICTS
    assert "Drawing helps." in studies_page([whole], {})
    sizes = {"full": {"seeds": 2}, "quick": {"seeds": 2}}
    digest = whole.digest
    other = found("one", ZERO, evaluations=CARTS, finding={**AGREES, "digest": digest})
    for each, status in (
        (judged("one", HIGH, AGREES, evaluations=CARTS, sizes=sizes, size="quick"), Status.OPEN),
        (judged("one", {"wide": HIGH["wide"]}, AGREES, evaluations=CARTS), Status.INCOMPLETE),
        (found("one", HIGH, evaluations=CARTS, finding=AGREES), Status.OPEN),
        (other, Status.FAILS),
    ):
        assert each.status() is status
        assert "Drawing helps." not in studies_page([each], {})
    said = f"is about other results (digest {digest}; these have {other.digest})."
    assert f"The finding in one/study.yaml {said}" in studies_page([other], {})


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


def test_a_single_agent_that_no_interquartile_mean_shows_changes_the_digest() -> None:
    values = {"wide": on_carts(*[(4000, 4000)] * 10)}
    whole = judged("one", values, AGREES, evaluations=CARTS, arms=[{"name": "wide", "label": "drawn"}])
    *others, last = whole.agents
    failed = replace(whole, agents=(*others, replace(last, values={"simulated": 0.0, "emulated": 0.0})))
    assert whole.estimates("emulated")["drawn"].value == failed.estimates("emulated")["drawn"].value == 4000
    assert (whole.finding is None, failed.finding) == (False, None)


def test_the_small_file_has_the_same_digest_and_damage_in_it_is_refused() -> None:
    results = found(
        "one", {"wide": on_carts((1234.49999999, 2500), (1234.5, 0.12344999999))}, evaluations=CARTS
    )
    text = json.dumps(as_json(results))
    assert from_json(json.loads(text), results.study).digest == results.digest
    agent = {"arm": "wide", "seed": 5, "run": "x", "values": {}, "curves": {}}
    for change, message in (
        ({"name": "../../evil"}, "'../../evil' is no name of a study"),
        ({"format": 2}, "format 2; this version reads format 1"),
        ({"agents": [agent | {"values": {"emulated": float("nan")}}]}, "nan is no number"),
        ({"agents": [agent | {"values": {"emulated": True}}]}, "True is no number"),
        (
            {"agents": [agent | {"arm": "moon"}]},
            "agent moon/5 is of an arm or evaluation that the study lacks",
        ),
        ({"agents": [agent | {"values": {"moon": 1}}]}, "agent wide/5 is of an arm or evaluation"),
        ({"agents": [agent, agent]}, "agent wide/5 is there twice"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            from_json(json.loads(text) | change, results.study)


def test_each_evaluation_that_a_study_judges_counts() -> None:
    carts = [*CARTS, {"name": "large", "label": "large cart"}]
    agents = [{"simulated": 4000.0, "emulated": 4500.0, "large": 150.0}] * 2
    results = found("one", {"wide": agents, "none": agents}, evaluations=carts, judged=["emulated", "large"])
    assert answer(results) == [
        "Score (6.2) on the emulated cart: each of 2 set-ups 4500 (4500 to 4500), 2 agents.",
        "Score (6.2), large cart: each of 2 set-ups 150 (150 to 150), 2 agents.",
    ]
    assert (results.status(), results.reason()[-13:]) == (Status.FAILS, " (large cart)")


def test_robustness_is_the_mean_share_of_successes_over_criteria() -> None:
    first = {"wide": over_knocks((4000, 3000), (4000, 500)), "none": over_knocks((4000, 0), (100, 0))}
    second = {"wide": over_knocks((4000, 4000), (4000, 4000)), "none": over_knocks((0, 0), (0, 0))}
    knocks, mass = (
        found(f"robustness_{name}", values, evaluations=KNOCKS, axis={"label": name})
        for name, values in (("knock", first), ("mass", second))
    )
    assert [[*row.values()] for row in robustness([knocks, mass])] == [
        ["drawn", "75 %", "100 %", "88 % (75 % to 100 %)", 2],
        ["not drawn", "25 %", "0 %", "12 % (0 % to 25 %)", 2],
    ]
    lacking = found(
        "robustness_knocks", {**first, "wide": first["wide"][:1]}, evaluations=KNOCKS, axis={"label": "k"}
    )
    assert [*robustness([lacking])[1].values()] == ["drawn", "–", "–", 1]


def test_the_answer_follows_the_interval_of_the_rank_correlation() -> None:
    for sign, noise, verdict in (
        (1, 0.1, "predicts well"),
        (1, 1.5, "predicts in part"),
        (0, 1, "is not shown to predict"),
        (-1, 0.5, "contradicts"),
    ):
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
    rho, low, high, _ = rank_correlation(values, others) or [None] * 4
    assert rho == pytest.approx(stats.spearmanr(values, others).statistic)
    assert -1 <= low < rho < high <= 1
    assert rank_correlation([1.0, 2.0, 3.0], [4.0, 9.0, 20.0]) == (1.0, None, None, 3)
    assert rank_correlation([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]) is rank_correlation([1.0], [1.0]) is None
