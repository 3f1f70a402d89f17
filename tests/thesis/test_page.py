"""The page of studies: what it says and in which order, its figures, and what a browser shows of it."""

import html
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import report as script
from page import studies_page
from reading import read_study
from results import StudyResults
from shown_pages import loaded, needs_browser, shown
from small_results import found

from cartpole_rl.choices import conf_folder

Edit = Callable[[Path, Callable[[Any], object]], None]
Report = Callable[..., tuple[str, str]]


@pytest.fixture
def report(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Report:
    """Make a page in the working directory, and return what is printed and the page."""

    def make(*words: str, code: int = 0) -> tuple[str, str]:
        shutil.rmtree("report", ignore_errors=True)
        monkeypatch.setattr(sys, "argv", ["report.py", *words, "--output", "report"])
        assert script.main() == code
        file, printed = Path("report/page.html"), capsys.readouterr()
        return printed.out + printed.err, file.read_text(encoding="utf-8") if file.exists() else ""

    return make


@needs_browser
def test_a_browser_shows_the_page_on_a_phone_and_in_the_dark(study: Path, report: Report) -> None:
    (study / "much/11/evaluations/heavy/metrics.json").unlink()
    out, page = report("quick", "--data", "data")
    assert "6 runs count, 1 does not; the page says why\n" in out
    assert all(source.startswith("data:image/") for source in loaded(page))
    phone = shown(page, "--window-size=500,900")
    assert (phone["errors"], phone["console"], phone["lost"]) == ([], [], [])
    assert len(phone["images"]) == 4  # animations of the best, the median and the worst agent; behaviour
    assert all(alt and width > 0 for alt, width in phone["images"])
    assert len(phone["figures"]) >= 4
    assert all(label and height > 50 for label, height in phone["figures"])
    assert phone["overflow"] <= 0
    dark = shown(page, "--blink-settings=preferredColorScheme=0")
    assert (phone["paper"], phone["text"]) == ("rgb(255, 255, 255)", "rgb(34, 34, 34)")
    assert (dark["paper"], dark["text"]) == ("rgb(22, 24, 28)", "rgb(230, 230, 230)")


def test_the_page_says_what_is_asked_answered_missing_and_excluded(
    study: Path, edit: Edit, report: Report
) -> None:
    _, page = report("quick", "--no-animations")
    head = page[page.index("<h1>") : page.index('id="summary"')]
    for part in ("1 study, size quick: 6 agents.", "No real cart was driven.", "At most 3 agents per set-up"):
        assert part in head
    for part in (
        "Does friction matter?",
        "It was not asked.",
        "Energy and LQR &lt;with&gt; friction",
        "scripts/reproduce friction --studies FOLDER --folder . --size quick",
        "{seed}: one run for each seed (10 to 12 here).",
        '<td data-label="run">quick/friction/much/12</td>',
    ):
        assert part in page
    assert 'class="box"' not in page

    def change(content: dict[str, Any]) -> None:
        content["evaluations"][0].update(overrides=["plant=serial"], of_arms={"much": ["pole=large"]})
        content["evaluations"][1].update(overrides=["plant=emulated", "emulator=large"])

    heavy = Path("quick/friction/much/11/evaluations/heavy")
    (heavy / "metrics.json").unlink()
    edit(study / "much/10/evaluations/heavy/provenance.json", lambda content: content.update(git_commit="a"))
    edit(study / "study.yaml", change)
    out, page = report("quick", "--no-animations")
    assert "incomplete: friction" in out
    (box,) = re.findall(r'<aside class="box".*?</aside>', page, re.S)
    assert "Missing: much friction, heavy cart: 2 of 3 seeds, 11 is missing." in box
    assert f"{heavy} does not count: unfinished: it has no metrics.json." in box
    assert "commits" not in box
    assert "commits with the same package versions" in page[page.index("The 6 runs behind it") :]
    assert "No real cart was driven." not in page
    assert "# agents of much friction:" in page
    assert html.escape((conf_folder() / "emulator/large.yaml").read_text()) in page


def test_what_fails_comes_first(study: Path, edit: Edit, report: Report) -> None:
    digest = read_study(study).digest
    for name in ("agrees", "contradicts"):
        shutil.copytree(study, f"quick/{name}")
        finding = {"size": "quick", "verdict": name, "comment": f"why it {name}", "digest": digest}
        changes = {"finding": finding, "title": name, "order": 10}
        edit(Path("quick", name, "study.yaml"), lambda content, changes=changes: content.update(changes))
    out, page = report("quick", "--no-animations")
    assert "contradicts the thesis: contradicts" in out
    summary = page[page.index('id="summary"') : page.index("</section>")]
    assert re.findall("#study-(\\w+)", summary) == ["contradicts", "friction", "agrees"]
    assert "why it contradicts" in summary
    edit(Path("quick/agrees/study.yaml"), lambda content: content["finding"].update(digest="00000000"))
    out, page = report("quick", "--no-animations")
    other = f"is about other results (digest 00000000; these have {digest})."
    assert f"agrees: The finding in quick/agrees/study.yaml {other} That of these has digest:" in out
    assert other in page
    assert "why it agrees" not in page


def test_each_figure_is_a_file_and_the_small_files_make_the_same_page(study: Path, report: Report) -> None:
    out, whole = report("quick", "--data", "data", "--no-animations", "--figures")
    files = sorted(Path("report/figures").glob("*.svg"))
    assert f"report/figures/ holds {len(files)} figures" in out
    assert len(files) == whole.count("<svg") > 3
    shutil.rmtree("quick")
    _, page = report("data")
    drawn = re.compile(r"<svg.*?</svg>", re.S)  # the figures differ by the digits that a file keeps
    assert drawn.sub("", page) == drawn.sub("", whole)
    out, page = report("nowhere", code=2)
    assert (out, page) == ("scripts/thesis/report.py: nowhere: there is no such folder\n", "")


def placed(name: str, order: int = 0, is_shipped: bool = False, **more: Any) -> StudyResults:
    agents = {"wide": [{"own": float(seed)} for seed in range(3)]}
    arms, sizes = [{"name": "wide", "label": "cost $5 to $6"}], {"quick": {"seeds": 1}}
    more |= {"folder": f"here/quick/{name}", "shipped": is_shipped}
    return found(name, agents, more, title=f"Study {name}", order=order, arms=arms, sizes=sizes)


def test_every_study_is_in_the_contents_whatever_its_order() -> None:
    results = [placed(f"n{order}", order, True) for order in (10, 195, 200)]
    results += [placed(f"own{order}", order) for order in (-3, 10, 250)]
    page = studies_page(results, {})
    contents = page[page.index('id="contents"') : page.index("</nav>")]
    assert {*re.findall("#study-(\\w+|own-3)", contents)} >= {each.name.split("-")[0] for each in results}
    assert contents.count("no study") == 17
    assert contents.index("study-n195") > contents.index("Beyond the thesis")
    assert contents.index("study-own10") > contents.index("Own studies")
    assert "scripts/reproduce n10 --size quick" in page
    own = studies_page([placed('a"><img src=x>'), placed("b")], {})
    assert ("no study" in own, "<img" in own) == (False, False)
    assert 'id="study-a---img-src-x-"' in own
    ids = re.findall(r'\bid="([^"]+)"', own)
    assert len({*ids}) == len(ids) > 4  # also those of the same figure
    assert "cost $5 to $6" in re.findall(r"<text[^>]*>([^<]*)</text>", own)  # no formula
    assert "No result yet." in studies_page([found("one", {})], {})
