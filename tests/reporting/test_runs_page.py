"""cartpole-report writes pages that a browser shows: no error, every picture, every link inside the page."""

from pathlib import Path

import pytest
from command_line import Outcome, in_process
from shown_pages import loaded, needs_browser, shown

FOLDER = "hydra.run.dir=report"


def report(*words: str) -> tuple[Outcome, str]:
    """Make a report in the working directory; return the outcome and the page."""
    done = in_process("report", *words, FOLDER, folder=Path.cwd())
    page = Path("report/page.html")
    return done, page.read_text() if page.is_file() else ""


@needs_browser
def test_a_browser_shows_the_page_of_two_sets_of_runs(study: Path) -> None:
    words = ("runs=quick/friction/little", "compare=quick/friction/much", "measure=score_upright")
    done, page = report(*words, "figures=true")
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == "report/page.html is written"
    assert all(source.startswith("data:image/") for source in loaded(page))
    found = shown(page, "--window-size=500,900")
    assert (found["errors"], found["console"], found["lost"]) == ([], [], [])
    assert all(alt and width > 0 for alt, width in found["images"])
    assert found["overflow"] <= 0
    assert '<td data-label="setting">parameters.cart_viscous</td>' in page
    assert len(Path("report/runs.csv").read_text().splitlines()) == 13
    files = list(Path("report/figures").glob("*.svg"))
    assert len(files) == page.count("<svg") > 0
    assert all("<svg" in file.read_text(encoding="utf-8") for file in files)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ((), "give runs=<run folders or patterns>"),
        (("runs=nowhere",), "runs=nowhere: there is no such folder; give a run folder"),
        (("runs=quick", "studies=quick"), "studies: there is no such setting"),
        (("runs=quick", "measure=bogus"), "measure=bogus: no run has it; there are score, score_upright, "),
    ],
)
def test_wrong_settings_are_refused_in_one_line(words: tuple[str, ...], complaint: str, study: Path) -> None:
    done, page = report(*words)
    assert done.code == 2
    assert complaint in done.complaint
    assert page == ""
    assert not Path("report").exists()
