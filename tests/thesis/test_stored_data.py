"""The stored results of the studies: complete data, and a row in the pages for each study.

docs/thesis-results.md has those of the thesis with their verdicts, docs/thesis.md those beyond it.
"""

import re

import pytest
from page import BEYOND
from page_commands import ROOT
from reading import read_studies
from results import StudyResults
from study import study_names

OF_THE_THESIS = re.compile(r"(\| [^|]+ ){3}\| (?P<verdict>[^|]+) \| `(?P<study>\w+)` \|")
BEYOND_IT = re.compile(r"(\| [^|]+ ){2,}\| `(?P<study>\w+)` \|")
RESULTS = [each for each in read_studies(ROOT / "docs/results/thesis") if each.agents]


def test_every_study_has_results() -> None:
    assert {each.name for each in RESULTS} == {*study_names()}


@pytest.mark.parametrize("results", RESULTS, ids=lambda results: results.name)
def test_the_data_are_complete_and_have_a_finding(results: StudyResults) -> None:
    assert (results.label, results.missing(), results.exclusions) == ("full", [], ())
    assert results.finding is not None


def test_set_ups_have_ten_agents() -> None:
    counts = {each.name: {len(each.members(arm.name)) for arm in each.groups} for each in RESULTS}
    assert {name for name, count in counts.items() if count != {10}} == {"integrators"}  # a pole alone


def rows(page: str, row: re.Pattern[str]) -> list[re.Match[str]]:
    return [found for found in map(row.fullmatch, (ROOT / page).read_text().splitlines()) if found]


def test_the_table_has_each_study_of_the_thesis_with_the_verdict_of_its_finding() -> None:
    found = {row["study"]: row["verdict"] for row in rows("docs/thesis-results.md", OF_THE_THESIS)}
    assert found == {
        each.name: each.finding.verdict for each in RESULTS if each.finding and each.study.order < BEYOND
    }


def test_the_page_of_the_thesis_has_each_study_beyond_it() -> None:
    found = {row["study"] for row in rows("docs/thesis.md", BEYOND_IT)} & {*study_names()}
    assert found == {each.name for each in RESULTS if each.study.order >= BEYOND}
