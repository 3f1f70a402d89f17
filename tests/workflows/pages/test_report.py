"""cartpole-report writes pages that a browser shows: no error, every picture, every link inside the page."""

import html
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from command_line import Outcome, in_process

from cartpole_rl.choices import conf_folder
from cartpole_rl.workflows.pages.studies import read_study

Edit = Callable[[Path, Callable[[Any], object]], None]
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
FOLDER = "hydra.run.dir="
LIMIT = 20_000_000  # bytes of a page
COMMAND = "scripts/reproduce friction --studies FOLDER --folder . --size quick"
PROBE = """<script>
const broken = [];
window.addEventListener("error", event => broken.push(event.message));
window.addEventListener("load", () => {
  const wide = window.innerWidth;
  document.body.dataset.found = JSON.stringify({
    errors: broken,
    images: [...document.images].map(image => [image.alt, image.naturalWidth]),
    figures: [...document.querySelectorAll("svg[role=img]")].map(
      figure => [figure.getAttribute("aria-label"), figure.getBoundingClientRect().height]),
    lost: [...document.querySelectorAll("a")].map(link => link.getAttribute("href")).filter(
      href => !href.startsWith("#") || !document.getElementById(href.slice(1))),
    overflow: document.documentElement.scrollWidth - wide,
    paper: getComputedStyle(document.body).backgroundColor,
    text: getComputedStyle(document.querySelector("svg text")).fill,
  });
});
</script>"""


class Sources(HTMLParser):
    """Everything that a page loads."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = ("src", "srcset", "data") if tag not in ("link",) else ("href",)
        self.found += [value or "" for name, value in attrs if name in names]


def report(*words: str) -> tuple[Outcome, str]:
    """Make a report in the working directory; return the outcome and the page."""
    folder = next((word.removeprefix(FOLDER) for word in words if word.startswith(FOLDER)), "report")
    chosen = dict.fromkeys((*words, f"{FOLDER}{folder}"))
    done = in_process("report", *chosen, folder=Path.cwd())
    page = Path(folder, "page.html")
    return done, page.read_text() if page.is_file() else ""


def shown(page: str, *options: str) -> dict[str, Any]:
    """Open a page in a browser without a network; return what it shows."""
    probed = Path("probed.html").resolve()
    probed.write_text(page.replace("<head>", f"<head>{PROBE}"))
    assert BROWSER
    command = [
        BROWSER,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--proxy-server=127.0.0.1:9",
        "--enable-logging=stderr",
        "--virtual-time-budget=10000",
        *options,
        "--dump-dom",
        probed.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    found = re.search(r'data-found="([^"]*)"', done.stdout)
    assert found, done.stderr[-2000:]
    return {**json.loads(html.unescape(found[1])), "console": console}


needs_browser = pytest.mark.skipif(
    BROWSER is None, reason=f"no browser among {', '.join(BROWSERS)}: apt-get install chromium"
)


@needs_browser
def test_a_browser_shows_the_page_of_studies_on_a_phone_and_in_the_dark(study: Path) -> None:
    (study / "much/11/evaluations/heavy/metrics.json").unlink()
    done, page = report("studies=quick", "data=data")
    assert done.code == 0, done.err
    assert "\n6 runs count, 1 does not; the page says why\n" in done.out
    assert done.out.endswith("report/page.html is written\n")
    assert all(source.startswith("data:image/") for source in Sources(page).found)
    assert len(page) < LIMIT
    found = shown(page, "--window-size=500,900")
    assert (found["errors"], found["console"], found["lost"]) == ([], [], [])
    assert len(found["images"]) == 4  # animations of the best, the median and the worst agent; behaviour
    assert all(alt and width > 0 for alt, width in found["images"])
    assert len(found["figures"]) >= 4
    assert all(label and height > 50 for label, height in found["figures"])
    assert found["overflow"] <= 0
    dark = shown(page, "--blink-settings=preferredColorScheme=0")
    assert (found["paper"], found["text"]) == ("rgb(255, 255, 255)", "rgb(34, 34, 34)")
    assert (dark["paper"], dark["text"]) == ("rgb(22, 24, 28)", "rgb(230, 230, 230)")


@needs_browser
def test_a_browser_shows_the_page_of_two_sets_of_runs(study: Path) -> None:
    words = ("runs=quick/friction/little", "compare=quick/friction/much", "measure=score_upright")
    done, page = report(*words)
    assert done.code == 0, done.err
    assert all(source.startswith("data:image/") for source in Sources(page).found)
    found = shown(page, "--window-size=500,900")
    assert (found["errors"], found["console"], found["lost"]) == ([], [], [])
    assert all(alt and width > 0 for alt, width in found["images"])
    assert found["overflow"] <= 0
    assert '<td data-label="setting">parameters.cart_viscous</td>' in page
    assert len(Path("report/runs.csv").read_text().splitlines()) == 13


def test_the_page_says_what_is_missing_and_what_does_not_count(study: Path) -> None:
    (study / "much/11/evaluations/heavy/metrics.json").unlink()
    done, page = report("studies=quick", "animations=false")
    assert "incomplete: friction" in done.out
    box = re.search(r'<aside class="box".*?</aside>', page, re.S)
    assert box
    assert "Missing: much friction, heavy cart: 2 of 3 seeds, 11 is missing." in box[0]
    run = "quick/friction/much/11/evaluations/heavy"
    assert f"{run} does not count: unfinished: it has no metrics.json." in box[0]
    assert "<img" not in page


def test_the_page_has_question_answers_command_and_runs(study: Path) -> None:
    _, page = report("studies=quick/friction", "animations=false")
    for part in ("Does friction matter?", "It was not asked.", COMMAND):
        assert part in page
    for seed in (10, 11, 12):
        assert f'<td data-label="run">quick/friction/much/{seed}</td>' in page
    assert "Energy and LQR &lt;with&gt; friction" in page
    assert "<with>" not in page


def test_the_page_says_first_what_its_words_mean(study: Path, edit: Edit) -> None:
    _, page = report("studies=quick", "animations=false")
    head = page[page.index("<h1>") : page.index('id="summary"')]
    assert "1 study, size quick: 6 agents." in head
    for part in ("No real cart was driven.", "at most 5500", "95 % intervals", "Answered: the thesis has no"):
        assert part in head
    words = ["plant=serial"]
    edit(study / "study.yaml", lambda content: content["evaluations"][1].update(overrides=words))
    _, page = report("studies=quick", "animations=false", "hydra.run.dir=again")
    assert "No real cart was driven." not in page


def test_commits_stand_with_the_list_of_runs_and_not_in_a_box(study: Path, edit: Edit) -> None:
    edit(
        study / "much/11/evaluations/heavy/provenance.json", lambda content: content.update(git_commit="abc")
    )
    _, page = report("studies=quick", "animations=false")
    assert 'class="box"' not in page
    folded = page[page.index("The 6 runs behind it") :]
    assert re.search(r"The runs are of \d commits with the same package versions: .*\babc \(1\)", folded)


def test_the_commands_by_hand_name_set_ups_by_their_labels(study: Path, edit: Edit) -> None:
    edit(
        study / "study.yaml",
        lambda content: content["evaluations"][1].update(of_arms={"much": ["pole=large"]}),
    )
    _, page = report("studies=quick", "animations=false")
    assert "# agents of much friction:" in page
    assert "{run}: the run folder of an agent." in page


def test_what_fails_comes_first(study: Path, edit: Edit) -> None:
    shutil.copytree(study, "quick/agrees")
    shutil.copytree(study, "quick/contradicts")
    digest = read_study(study).digest
    for name in ("agrees", "contradicts"):
        edit(
            Path("quick", name, "study.yaml"),
            lambda content, name=name: content.update(
                finding={"size": "quick", "verdict": name, "comment": f"why it {name}", "digest": digest},
                title=name,
                order=10,
            ),
        )
    _, page = report("studies=quick", "animations=false")
    summary = page[page.index('id="summary"') : page.index("</section>")]
    order = [summary.index(f"#study-{name}") for name in ("contradicts", "friction", "agrees")]
    assert order == sorted(order)
    assert "why it contradicts" in summary
    contents = page[page.index('id="contents"') : page.index("</nav>")]
    assert contents.index("#study-agrees") < contents.index("#study-friction")
    assert "no study" not in contents  # they are a person's own


def test_a_finding_about_other_results_is_named_with_the_digest_to_enter(study: Path, edit: Edit) -> None:
    finding = {"size": "quick", "verdict": "agrees", "comment": "Friction matters.", "digest": "00000000"}
    edit(study / "study.yaml", lambda content: content.update(finding=finding))
    done, page = report("studies=quick", "animations=false")
    digest = read_study(study).digest
    other = f"is about other results (digest 00000000; these have {digest})."
    assert f"friction: The finding in quick/friction/study.yaml {other}" in done.out
    assert f'That of these has digest: "{digest}"' in done.out
    assert other in page
    assert "Friction matters." not in page


def test_a_damaged_picture_is_named_and_the_others_are_shown(study: Path) -> None:
    gif = study / "much/11/evaluations/heavy/figures/episode.gif"
    for evaluation in study.glob("*/*/evaluations/heavy/figures/episode.gif"):
        if evaluation != gif:
            evaluation.unlink()
    gif.write_bytes(gif.read_bytes()[:40] + bytes(500))
    done, page = report("studies=quick")
    assert done.code == 0, done.err
    assert f"note: {gif} is damaged and not shown" in done.err
    assert "data:image/webp" in page
    assert "data:image/gif" not in page


def test_the_page_says_what_stands_for_the_real_cart(study: Path, edit: Edit) -> None:
    _, without = report("studies=quick", "animations=false")
    words = ["plant=emulated", "emulator=large"]
    edit(study / "study.yaml", lambda content: content["evaluations"][1].update(overrides=words))
    _, page = report("studies=quick", "animations=false", "hydra.run.dir=again")
    text = (conf_folder() / "emulator/large.yaml").read_text()
    assert "is an emulator, not a real cart" in page
    assert html.escape(text) in page
    assert "is an emulator" not in without
    assert "At most 3 agents per set-up" in page


def test_each_figure_of_the_page_is_a_file_on_request(study: Path) -> None:
    done, page = report("studies=quick", "animations=false", "figures=true")
    files = sorted(Path("report/figures").glob("*.svg"))
    assert f"report/figures/ holds {len(files)} figures" in done.out
    assert len(files) == page.count("<svg")
    assert all("<svg" in file.read_text(encoding="utf-8") for file in files)


def test_a_report_without_agents_has_no_figures(study: Path) -> None:
    for arm in filter(Path.is_dir, [*study.iterdir()]):
        shutil.rmtree(arm)
    done, _ = report("studies=quick", "animations=false", "figures=true")
    assert "there is no figure" in done.out
    assert not Path("report/figures").exists()


def test_the_figures_of_two_sets_of_runs_are_files(study: Path) -> None:
    arms = [str(arm) for arm in sorted(study.iterdir()) if arm.is_dir()]
    done, page = report(f"runs={arms[0]}", f"compare={arms[1]}", "animations=false", "figures=true")
    assert done.code == 0, done.err
    assert len(list(Path("report/figures").glob("*.svg"))) == page.count("<svg") > 0


def test_a_page_from_the_small_files_alone(study: Path) -> None:
    _, whole = report("studies=quick", "data=data", "animations=false")
    shutil.rmtree("quick")
    shutil.rmtree("report")
    done, page = report("studies=data")
    assert done.code == 0, done.err
    assert re.split(r"<svg.*?</svg>", page, flags=re.S) == re.split(
        r"<svg.*?</svg>", whole, flags=re.S
    )  # the figures differ by the digits that a file keeps


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ((), "give either studies=<folder of studies> or runs=<run folders or patterns>"),
        (("studies=quick", "runs=quick"), "give either studies="),
        (("studies=nowhere",), "studies=nowhere: there is no such folder"),
        (("runs=nowhere",), "runs=nowhere: there is no such folder; give a run folder"),
        (("runs=quick", "data=here"), "data: a report on runs does not read it"),
        (("studies=quick", "measure=steps"), "compare and measure belong to runs="),
        (("runs=quick", "measure=bogus"), "measure=bogus: no run has it; there are score, score_upright, "),
    ],
)
def test_wrong_settings_are_refused_in_one_line(words: tuple[str, ...], complaint: str, study: Path) -> None:
    done, page = report(*words)
    assert done.code == 2
    assert complaint in done.complaint
    assert page == ""
    assert not Path("report").exists()
