"""The results of the thesis's studies: complete data, and a row in the README's table for each."""

import re

import pytest
from page_commands import README, ROOT

from cartpole_rl.reporting.studies.results import StudyResults
from cartpole_rl.workflows.pages.studies import read_studies

DATA = ROOT / "docs/results/thesis"
ROW = re.compile(r"\| [^|]+ \| [^|]+ \| [^|]+ \| (?P<verdict>[^|]+) \| `(?P<study>\w+)` \|")
ROWS = {
    row["study"]: row["verdict"]
    for row in map(ROW.fullmatch, README.read_text(encoding="utf-8").splitlines())
    if row
}
RESULTS = [each for each in read_studies(DATA) if each.agents]


@pytest.mark.parametrize("results", RESULTS, ids=lambda results: results.name)
def test_the_data_are_complete_and_have_a_finding(results: StudyResults) -> None:
    assert results.label == "full"
    assert not results.missing()
    assert not results.exclusions
    assert results.finding is not None


def test_the_table_has_each_study_with_the_verdict_of_its_finding() -> None:
    assert {each.name: each.finding.verdict for each in RESULTS if each.finding} == ROWS
