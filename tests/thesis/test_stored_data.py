"""The stored results of the studies: complete data, and pages whose tables and verdicts are theirs."""

import json
import math
import re
from functools import cache
from pathlib import Path

import pytest
from claims import PAGES, Evidence, Row, Word, bench_values, blocks, read_claims, rebuilt, stored
from page import BEYOND
from page_commands import ROOT
from results import StudyResults
from small_results import found
from study import STUDIES, study_names

BEYOND_IT = re.compile(r"(\| [^|]+ ){2,}\| `(?P<study>\w+)` \|")
read_claims, stored = cache(read_claims), cache(stored)  # half a second, and not where tests are collected


def every_result() -> list[StudyResults]:
    return [*stored().results.values()]


def test_every_study_has_results() -> None:
    assert {each.name for each in every_result()} == {*study_names()}


@pytest.mark.parametrize("study", sorted(path.stem for path in STUDIES.glob("*.yaml")))
def test_the_data_are_complete_and_have_a_finding(study: str) -> None:
    results = stored().results[study]
    assert (results.label, results.missing(), results.exclusions) == ("full", [], ())
    assert results.finding is not None


def test_set_ups_have_ten_agents() -> None:
    counts = {each.name: {len(each.members(arm.name)) for arm in each.groups} for each in every_result()}
    few = {name: min(count) for name, count in counts.items() if count != {10}}  # as their rows say
    three = ("balance_poles", "classical_reward", "falls", "fine_tuning_cart_alone", "lengths_on_cart")
    others = {"integrators": 2, "one_cart": 4, "bearing_and_drag": 6, "nine_levels": 5}
    assert few == others | dict.fromkeys(three, 3)


@cache
def generated() -> dict[str, str]:
    return blocks(read_claims(), stored())


@pytest.mark.parametrize("page", PAGES)
def test_tables_verdicts_and_numbers_are_those_of_the_data(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert rebuilt(text, generated()) == text, "run scripts/thesis/claims.py"


def test_each_study_of_the_thesis_has_a_row_and_the_verdict_of_its_rows() -> None:
    verdicts = {
        each.name: {"fails": "new"}.get(each.finding.verdict, each.finding.verdict)
        for each in every_result()
        if each.finding and each.study.order < BEYOND
    }
    assert stored().study_words(read_claims().rows) == verdicts


@pytest.mark.parametrize(
    ("claim", "word"),
    [
        ("difference high/own low/own > 0", Word.AGREES),
        ("difference low/own high/own > 0", Word.CONTRADICTS),
        ("difference low/own low/own > 0", Word.NOT_SHOWN),
        ("difference low/own low/own ~ 0", Word.AGREES),
        ("mean low/own = 4.5", Word.NOT_SHOWN),
        ("mean high/own = 4.5", Word.CONTRADICTS),
        ("most high/own > 100", Word.AGREES),
        ("over 100 high/own > 0.5", Word.AGREES),
        ("over 4 low/own < 0.5", Word.NOT_SHOWN),
        ("contrast high/own low/own low/own low/own > 0", Word.AGREES),
        ("contrast high/own low/own high/own low/own > 0", Word.NOT_SHOWN),
        ("beside low/own high/own > 109", Word.AGREES),
        ("beside high/own high/own > 110", Word.NOT_SHOWN),
        ("difference high/own low/own > 0; over 4 low/own < 0.5", Word.NOT_SHOWN),
        ("", Word.NEW),
    ],
)
def test_the_word_follows_the_interval(claim: str, word: Word) -> None:
    agents = {"low": [{"own": float(x)} for x in range(10)], "high": [{"own": 101.0 + x} for x in range(10)]}
    evidence = Evidence({"one": found("one", agents)})
    row = Row(place="1", thesis="", study="one", claim=claim)
    assert evidence.word(row) is word
    explained = row.model_copy(update={"because": True})
    assert evidence.word(explained) is (Word.DIFFERS if word is Word.CONTRADICTS else word)


def test_a_seed_that_never_learned_counts(tmp_path: Path) -> None:
    seeds = [
        {"plants": {"x": {"score": 1.0}}, "seconds_to_reached": each, "kept": each} for each in (0.5, None)
    ]
    (tmp_path / "learning.json").write_text(json.dumps({"medium": dict(zip("01", seeds, strict=True))}))
    found = bench_values(tmp_path)
    assert found["learning/medium/seconds_to_reached"].tolist() == [0.5, math.inf]
    assert found["learning/medium/kept"].tolist() == [0.5, 0.0]


def rows(page: str, row: re.Pattern[str]) -> list[re.Match[str]]:
    return [match for match in map(row.fullmatch, (ROOT / page).read_text().splitlines()) if match]


def test_the_page_of_the_thesis_has_each_study_beyond_it() -> None:
    shown = {row["study"] for row in rows("docs/thesis.md", BEYOND_IT)} & {*study_names()}
    assert shown == {each.name for each in every_result() if each.study.order >= BEYOND}
