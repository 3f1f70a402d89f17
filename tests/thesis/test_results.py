"""The results of a study: its verdict, the finding that is bound to them, ratios, and the small JSON file."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from charts import rank_agreements, rank_correlation
from page import studies_page
from results import Status, as_json, from_json
from scipy import stats
from small_results import CARTS, Values, found, judged, on_carts

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
        assert (each.status(), each.finding) == (status, None)
    said = f"is about other results (digest {digest}; these have {other.digest})."
    page = studies_page([other], {})
    assert f"The finding in one/study.yaml {said}" in page
    assert "Drawing helps." not in page


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
