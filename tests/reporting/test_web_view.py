"""The live page over HTTP, and in a headless browser: what it shows, whom it refuses, and its stop button."""

import http.client
import json
import math
import multiprocessing
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest
from browser import BROWSER, BROWSERS
from command_line import COARSE, in_process
from toy_settings import TOY

from cartpole_rl.evaluation.snapshots import Memory, Snapshot, followed, write
from cartpole_rl.reporting import web_view
from cartpole_rl.reporting.web_view import NOTE, WebView, page
from cartpole_rl.workflows.config import TrainConfig, load_settings
from cartpole_rl.workflows.train import train

pytestmark = pytest.mark.usefixtures("without_pictures")
CALM = Snapshot(2, 120, -100, 0, 0, 1, 0.19, -0.25, 0.01, 0.5, 812.4, 0.38, 0.34)
EPISODE = {
    "name": "episode_000",
    "track": 0.38,
    "time": [0.0, 0.02],
    **{name: [0, 0] for name in ("x", "theta", "motor", "guard", "score")},
    **{name: [None, None] for name in ("ghost_x", "ghost_theta")},
}


def ask(address: str, method: str, name: str, **headers: str) -> tuple[int, str]:
    """The status and the text of an answer."""
    place = urlsplit(address)
    connection = http.client.HTTPConnection(place.netloc, timeout=100)
    connection.request(method, place.path + name, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def snapshot(address: str, fits: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first snapshot that fits."""
    while True:
        found = json.loads(ask(address, "GET", "now")[1])["snapshot"]
        if found and fits(found):
            return found
        time.sleep(0.01)


def test_the_button_stops_a_driven_cart_and_keeps_its_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter, pool, answers = WebView.__enter__, ThreadPoolExecutor(), []

    def stop(address: str) -> list[tuple[int, str]]:
        snapshot(address, lambda found: found["episode"] > 1 and found["motor"] != 0)
        return [ask(address, "POST", "stop", **each) for each in ({"Origin": "http://elsewhere.example"}, {})]

    def entered(view: WebView) -> WebView:
        answers.append(pool.submit(stop, view.address))
        return enter(view)

    monkeypatch.setattr(WebView, "__enter__", entered)
    journal = tmp_path / "journal.jsonl"
    words = f"run=lqr plant=emulated {COARSE} emulator.journal={journal} task=swingup task.duration=2 "
    given = (words + "episodes=1000 view=web hydra.run.dir=run").split()
    done = in_process("evaluate", *given, folder=tmp_path)
    (refused, _), (status, text) = answers[0].result()
    assert (refused, status) == (403, 200)
    assert web_view.STOPPED in text
    assert done.code == 130
    assert done.err.splitlines()[-1] == f"cartpole-evaluate: interrupted; {NOTE}"
    assert json.loads((tmp_path / "run/metrics.json").read_text())["episodes"]
    told = [json.loads(line) for line in journal.read_text().splitlines()]
    forces = [line["in_force"] for line in told if "in_force" in line]
    assert any(forces)
    assert forces[-1] == 0


def test_it_answers_its_own_computer_alone() -> None:
    with WebView("cart", 0.36) as view:
        assert view.memory is not None
        assert "Waiting for the cart" in ask(view.address, "GET", "")[1]
        write(view.memory, 1, CALM)
        assert snapshot(view.address, bool) == CALM._asdict()
        wrong = view.address[:-2] + "/"
        for method, address, name, headers, status in (
            ("GET", view.address, "", {"Host": "elsewhere.example"}, 403),
            ("POST", view.address, "stop", {"Host": "elsewhere.example"}, 403),
            ("POST", view.address, "stop", {"Origin": "null"}, 403),
            ("POST", wrong, "stop", {}, 404),
            ("GET", wrong, "now", {}, 404),
            ("GET", view.address, "stop", {}, 404),
            ("POST", view.address, "start", {}, 404),
            ("POST", view.address, "stop", {"Content-Length": "100000"}, 413),
        ):
            assert ask(address, method, name, **headers)[0] == status, (method, name, headers)
        assert urlsplit(view.address).hostname == "127.0.0.1"


def test_a_page_whose_process_is_suspended_holds_up_nothing() -> None:
    long = EPISODE | {"time": [0.0] * 100_000}  # more than a pipe takes
    with WebView("training", 0.36, [], grows=True) as view:
        os.kill(view._process.pid, signal.SIGSTOP)
        view.add(long)
    assert not view._process.is_alive()


def test_the_page_outlives_the_signals_of_a_terminal_from_its_first_moment() -> None:
    """The run that it belongs to ends it, and a page that is still starting leaves no traceback."""
    with WebView("training", 0.36, [], grows=True) as view:
        for number in (signal.SIGINT, signal.SIGHUP):
            os.kill(view._process.pid, number)
        assert ask(view.address, "GET", "")[0] == 200


def press(address: str, answer: str) -> None:
    """Press the button until it interrupts: Python loses an interrupt that comes in a destructor."""
    for _ in range(20):
        assert answer in ask(address, "POST", "stop")[1]
        time.sleep(5)


def drive_in_a_process_of_its_own(memory: Memory, events: Connection) -> None:
    one_cart = SimpleNamespace(plant=SimpleNamespace(drives_one_cart=True))
    followed(one_cart, memory)  # type: ignore[arg-type]
    with suppress(KeyboardInterrupt):
        events.send("drives")
        time.sleep(100)
    events.send("stopped")


def test_the_button_reaches_the_process_that_drives() -> None:
    """Beside its parent, which may be busy with learning."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    with WebView("cart", 0.36) as view:
        driving = context.Process(target=drive_in_a_process_of_its_own, args=(view.memory, theirs))
        driving.start()
        try:
            assert ours.recv() == "drives"
            with pytest.raises(KeyboardInterrupt):
                press(view.address, "motor")
            assert ours.poll(30)
            assert ours.recv() == "stopped"
        finally:
            driving.kill()


def test_a_recording_is_shown_until_it_is_closed() -> None:
    with WebView("Replay", 0.36, [EPISODE]) as view:
        assert json.loads(ask(view.address, "GET", "recording?from=0")[1]) == [EPISODE]
        assert json.loads(ask(view.address, "GET", "recording?from=1")[1]) == []
        assert ask(view.address, "GET", "recording?from=x")[0] == 404
        with pytest.raises(KeyboardInterrupt):
            press(view.address, web_view.CLOSED)


def test_words_of_a_title_are_no_markup() -> None:
    assert "<h1>&lt;b&gt;</h1>" in page("<b>", 0.36, replays=False)


PROBE = """<script>
const seen = new Set();
setInterval(() => {
  const position = document.querySelector("dl div:nth-child(2) dd");
  if (position) seen.add(position.textContent);
  if (seen.size === 3) element("stop").click();
}, 10);
</script></body>"""


NEWEST = """<script>
let seen = 0;
for (const [number, episode, step] of [[1, 1, 60], [1, 1, 60], [2, 1, 61], [3, 2, 200]]) {
  follow({ number, snapshot: { episode, step, x: 0, theta: 0, motor: 0, guard: 0, score: 0 } });
  if (points.length !== [1, 1, 2, 1][seen++]) throw new Error("the trace mixes episodes");
}
setInterval(() => { if (element("state").textContent === "the second") element("stop").click(); }, 10);
</script></body>"""


def drive_before_a_browser(folder: Path) -> None:
    """Move the cart of a page that a browser shows, until this process is interrupted."""
    with WebView("cart", 0.36) as view, open_browser(view, folder):
        assert view.memory is not None
        for number in count(1):
            write(view.memory, number, CALM._replace(step=number, x=0.01 * (number % 30)))
            time.sleep(0.02)


def add_before_a_browser(folder: Path) -> None:
    """Add two episodes to a page that a browser shows, and wait for its button."""
    with WebView("Training", 0.36, (), grows=True) as view, open_browser(view, folder):
        view.add({**EPISODE, "name": "the first"})
        while "the first" not in ask(view.address, "GET", "recording?from=0")[1]:
            time.sleep(0.01)
        view.add({**EPISODE, "name": "the second"})
        time.sleep(100)


@pytest.mark.skipif(BROWSER is None, reason=f"none of {', '.join(BROWSERS)} is installed")
@pytest.mark.parametrize(
    ("probe", "run"),
    [(PROBE, drive_before_a_browser), (NEWEST, add_before_a_browser)],
    ids=["a cart in three places", "the newest evaluation of a training"],
)
def test_a_browser_shows_it_and_its_button_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, probe: str, run: Callable[[Path], None]
) -> None:
    """The page presses its button once it has shown it."""
    monkeypatch.setattr(web_view, "page", lambda *given: page(*given).replace("</body>", probe))
    with pytest.raises(KeyboardInterrupt) as stopped:
        run(tmp_path)
    assert stopped.value.__notes__ == [NOTE]


def test_a_training_shows_the_first_episode_of_each_evaluation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown, add = [], WebView.add

    def added(view: WebView, episode: dict[str, Any]) -> None:
        add(view, episode)
        while len(found := json.loads(ask(view.address, "GET", "recording?from=0")[1])) == len(shown):
            time.sleep(0.01)
        shown.append(found[-1])

    monkeypatch.setattr(WebView, "add", added)
    toy = {**TOY[TrainConfig], "learning.evaluations": 2, "task.time_limit": 50, "view": "web"}
    toy |= {"task.angle_limit": math.pi}  # it judges by score_upright
    train(load_settings(TrainConfig, toy), tmp_path / "run")
    history = [json.loads(line) for line in (tmp_path / "run/history.jsonl").read_text().splitlines()]
    assert [each["name"] for each in shown] == [
        f"{each['transitions'] / 1e6:.2f} M transitions: mean score_upright {each['score_upright']:z.0f}"
        for each in history
    ]
    assert {len(each["theta"]) for each in shown} == {51}


@contextmanager
def open_browser(view: WebView, folder: Path) -> Iterator[None]:
    """Show the page of `view` in a browser meanwhile."""
    assert BROWSER is not None
    words = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}"]
    command = [BROWSER, *words, "--remote-debugging-port=0", view.address]
    browser = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        browser.terminate()
        browser.wait()
