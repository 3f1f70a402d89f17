"""The results of the studies: complete data, and a row in the README for each of the thesis.

Those beyond it have theirs in docs/thesis.md.
"""

import re
from pathlib import Path

import pytest
from page_commands import README, ROOT

from cartpole_rl.reporting.studies.answers import BEYOND
from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.workflows.pages.studies import read_studies
from cartpole_rl.workflows.studies import study_names

DATA = ROOT / "docs/results/thesis"
OF_THE_THESIS = re.compile(r"(\| [^|]+ ){3}\| (?P<verdict>[^|]+) \| `(?P<study>\w+)` \|")
BEYOND_IT = re.compile(r"(\| [^|]+ ){2,}\| `(?P<study>\w+)` \|")
RESULTS = [each for each in read_studies(DATA) if each.agents]


def test_every_study_has_results() -> None:
    assert {each.name for each in RESULTS} == {*study_names()}


@pytest.mark.parametrize("results", RESULTS, ids=lambda results: results.name)
def test_the_data_are_complete_and_have_a_finding(results: StudyResults) -> None:
    assert results.label == "full"
    assert not results.missing()
    assert not results.exclusions
    assert results.finding is not None


def rows(page: Path, row: re.Pattern[str]) -> list[re.Match[str]]:
    return [found for found in map(row.fullmatch, page.read_text(encoding="utf-8").splitlines()) if found]


def test_the_readme_has_each_study_of_the_thesis_with_the_verdict_of_its_finding() -> None:
    found = {row["study"]: row["verdict"] for row in rows(README, OF_THE_THESIS)}
    assert found == {
        each.name: each.finding.verdict for each in RESULTS if each.finding and each.study.order < BEYOND
    }


def test_the_page_of_the_thesis_has_each_study_beyond_it() -> None:
    found = {row["study"] for row in rows(ROOT / "docs/thesis.md", BEYOND_IT)} & {*study_names()}
    assert found == {each.name for each in RESULTS if each.study.order >= BEYOND}
