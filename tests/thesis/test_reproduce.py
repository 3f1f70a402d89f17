"""A study at toy size: it is interrupted and continued, and a failed run does not end the others.

Runs that were made with other settings, or of an agent that was trained again, do not count as done.
"""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest
import reproduce as script
import yaml
from command_line import TINY, Outcome, outcome, same_handlers
from plan import Task, plan
from reproduce import Schedule, reproduce
from study import Study
from worker import carry_out, finish, is_complete, made_otherwise, prepare

from cartpole_rl.errors import ConfigError
from cartpole_rl.files import claimed
from cartpole_rl.reporting import style
from cartpole_rl.reporting.runs import read_run
from cartpole_rl.run_folder import recorded_provenance
from cartpole_rl.workflows import train

pytestmark = pytest.mark.nightly
TRAINED, IMPOSSIBLE, LQR, SHARED, HEN, EGG = (
    {"name": name, "label": name, "overrides": words}
    for name, words in {
        "trained": [],
        "impossible": ["cart.cart_mass=-1"],
        "lqr": ["run=lqr"],
        "shared": ["run={runs}/toy/trained/{seed}"],
        "hen": ["run={runs}/circle/egg/{seed}"],
        "egg": ["run={runs}/circle/hen/{seed}"],
    }.items()
)
LONG = [*TINY, "learning.transitions=20480", "learning.evaluations=10"]  # there is time to interrupt it
SIZE = {"seeds": 1, "overrides": LONG, "evaluation_overrides": ["episodes=1"]}
TOY: dict[str, Any] = {
    "title": "Toy",
    "order": 1,
    "question": "Does it run?",
    "experiment": "balance",
    "arms": [TRAINED, IMPOSSIBLE, LQR],
    "evaluations": [{"name": "own", "label": "own"}],
    "sizes": {"quick": SIZE},
}
STUDIES = {
    "toy": TOY,
    "sharing": {**TOY, "arms": [SHARED]},
    "short": {
        **TOY,
        "arms": [TRAINED],
        "evaluations": [],
        "sizes": {"quick": {**SIZE, "overrides": [*TINY]}},
    },
    "lqr": {**TOY, "arms": [LQR], "evaluations": []},
    "circle": {**TOY, "arms": [HEN, EGG], "command": "finetune"},
}
PARENT = """
import multiprocessing, time, worker
worker.finish = lambda task: time.sleep(600)
process = multiprocessing.get_context("fork").Process(target=worker.in_own_process, args=(None, None))
process.start()
print(process.pid, flush=True)
time.sleep(600)
"""


class Done(NamedTuple):
    """A study that was interrupted and continued."""

    root: Path
    stopped: Outcome
    failures: dict[str, str]
    lines: list[str]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of studies."""
    folder = tmp_path_factory.mktemp("study")
    for name, content in STUDIES.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return folder


@pytest.fixture(scope="module")
def done(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    """A study, interrupted as a process of its own and continued in this one."""
    folder = tmp_path_factory.mktemp("my #runs")
    words = ("toy", "--studies", source, "--folder", folder.name, "--jobs", "2")
    command = [sys.executable, script.__file__, *map(str, words)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, cwd=folder.parent, stdout=pipe, stderr=pipe, text=True)
    while not [*folder.glob("*/*/*/*/checkpoints/resume.pt")] and process.poll() is None:
        time.sleep(0.01)
    started = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    stopped = outcome(process)
    assert psutil.wait_procs(started, timeout=60)[1] == []
    lines: list[str] = []
    failures = reproduce(["toy"], "quick", folder / "quick", 2, source, lines.append)
    return Done(folder / "quick", stopped, failures, lines)


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], source: Path) -> Any:
    """Call scripts/reproduce in this process with words and the folder of studies."""

    def call(*words: object) -> Outcome:
        monkeypatch.chdir(Path.cwd())  # the script changes it
        monkeypatch.setattr(sys, "argv", ["", "--studies", str(source), *map(str, words)])
        with same_handlers():
            code = script.main()
        return Outcome(code, *capsys.readouterr())

    return call


def test_an_interrupted_reproduction_is_continued(done: Done) -> None:
    assert done.stopped.code == 130
    assert done.stopped.complaint == "scripts/reproduce: interrupted; the same command continues"
    run = done.root / "toy/trained/10"
    assert "interrupted" in (run / "log.txt").read_text().splitlines()
    assert "resumed" in recorded_provenance(run)
    assert not (run / "checkpoints/resume.pt").exists()
    for arm in ("trained", "lqr"):
        metrics = json.loads((done.root / f"toy/{arm}/10/evaluations/own/metrics.json").read_text())
        assert len(metrics["episodes"]) == 1
    written = Study(**yaml.safe_load((done.root / "toy/study.yaml").read_text()))
    assert (written.size, written.title) == ("quick", "Toy")


def test_a_failure_does_not_end_the_others(done: Done) -> None:
    assert done.failures == {
        "toy/impossible/10": "cart_mass is -1; it must be above 0 and at most 100",
        "toy/impossible/10/evaluations/own": f"it needs {done.root}/toy/impossible/10, which failed",
    }
    assert re.match(r"6 runs, \d of them done; 2 at a time, in ", done.lines[0])
    numbered = [line.split("]")[0] for line in done.lines if line.startswith("[")]
    assert numbered == [f"[{number}/{len(numbered)}" for number in range(1, len(numbered) + 1)]


def test_an_agent_of_another_study_is_not_trained_again(done: Done, source: Path, called: Any) -> None:
    schedule = Schedule(plan(["sharing"], "quick", Path("none"), source), Path("none"))
    (first,) = schedule.ready(5)
    assert first.folder == Path("none/toy/trained/10")
    schedule.finish(first, "")
    assert [task.study for task in schedule.ready(5)] == ["sharing"]  # it waited
    lines: list[str] = []
    assert reproduce(["sharing"], "quick", done.root, 2, source, lines.append) == {}
    assert lines[0].startswith("2 runs, 1 of them done; 2 at a time")
    evaluated = yaml.safe_load((done.root / "sharing/shared/10/evaluations/own/config.yaml").read_text())
    assert evaluated["run"] == str(done.root / "toy/trained/10")
    again = called("sharing", "--folder", done.root.parent)
    assert (again.code, again.err) == (0, "")
    assert again.out.splitlines()[-1] == f"the page: scripts/thesis/report.py '{done.root}'"


def test_only_complete_runs_of_the_same_settings_and_agent_are_done(done: Done, source: Path) -> None:
    trained, evaluation = plan(["toy"], "quick", done.root, source)[:2]
    assert Schedule([trained, evaluation], done.root).waiting == []
    assert not made_otherwise(evaluation)
    elsewhere = plan(["toy"], "quick", done.root.resolve() / ".." / done.root.name, source)[1]
    assert not made_otherwise(replace(elsewhere, folder=evaluation.folder))
    assert made_otherwise(replace(evaluation, words=("episodes=7",))).startswith("it was made with other")
    checkpoint, metrics = trained.folder / "checkpoints/last.pt", evaluation.folder / "metrics.json"
    content, whole = checkpoint.read_bytes(), metrics.read_text()
    checkpoint.write_bytes(content + b"again")
    assert not is_complete(evaluation)
    assert read_run(evaluation.folder).problem.startswith("a run that it needs was made again")
    checkpoint.unlink()
    (trained.folder / "metrics.json").rename(trained.folder / "no_metrics")
    waiting = Schedule([trained, evaluation], done.root).waiting
    assert waiting == [trained, evaluation]  # the agent that will be trained is another one
    (trained.folder / "no_metrics").rename(trained.folder / "metrics.json")
    checkpoint.write_bytes(content)
    metrics.write_text(json.dumps({**json.loads(whole), "episodes": []}))  # as after Ctrl-C
    assert not is_complete(evaluation)
    metrics.write_text(whole)
    assert is_complete(evaluation)


def test_a_study_of_other_settings_keeps_its_file_and_gets_no_more_runs(done: Done, tmp_path: Path) -> None:
    root, lines = tmp_path / "quick", []
    shutil.copytree(done.root / "toy", root / "toy")
    old = (root / "toy/study.yaml").read_text()
    sizes = {"quick": {**SIZE, "seeds": 2}}
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump({**TOY, "arms": [LQR], "sizes": sizes}))
    evaluation = root / "toy/lqr/10/evaluations/own/provenance.json"
    evaluation.write_text(json.dumps({**json.loads(evaluation.read_text()), "command": ["", "knock=8"]}))
    failures = reproduce(["toy"], "quick", root, 1, tmp_path, lines.append)
    assert "refused; 1 at a time" in lines[0]
    assert failures["toy/lqr/10/evaluations/own"].startswith("it was made with other settings")
    assert failures["toy/lqr/11"] == "other runs of its study were made with other settings"
    assert (root / "toy/study.yaml").read_text() == old


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot fork")
def test_a_run_ends_with_a_killed_reproduction() -> None:
    """The run's work is a long sleep here."""
    command, folder = [sys.executable, "-c", PARENT], Path(script.__file__).parent
    parent = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    run = psutil.Process(int(parent.stdout.readline()))
    time.sleep(0.5)
    parent.kill()
    parent.wait()
    run.wait(60)


def test_a_run_that_another_process_writes_is_left_alone(source: Path, tmp_path: Path) -> None:
    for name in ("short", "lqr"):
        (task,) = plan([name], "quick", tmp_path, source)
        task.folder.mkdir(parents=True)
        (task.folder / "config.yaml").write_text("its own")
        with (
            claimed(task.folder),
            pytest.raises(ConfigError, match=f"another process works in {task.folder}"),
        ):
            finish(task)
        assert (task.folder / "config.yaml").read_text() == "its own"
    with claimed(tmp_path), pytest.raises(ConfigError, match="another process works in"):
        reproduce(["lqr"], "quick", tmp_path, 1, source)


def test_a_run_that_ends_too_early_is_not_complete(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", [])
    for name, module, last in (("short", train, "forget_training"), ("lqr", style, "save")):
        (task,) = plan([name], "quick", tmp_path, source)
        with monkeypatch.context() as patched:
            patched.setattr(module, last, killed)
            with pytest.raises(KeyboardInterrupt):
                carry_out(task)
        assert not is_complete(task)
        resumed = prepare(task)
        carry_out(task, resumed)
        assert is_complete(task)
        assert resumed == ("resumed" in recorded_provenance(task.folder)) == (name == "short")


@pytest.mark.timeout(120)  # it would never end
def test_runs_that_need_each_other_fail(source: Path, tmp_path: Path) -> None:
    failures = reproduce(["circle"], "quick", tmp_path, 1, source, lambda line: None)
    runs = tmp_path / "circle"
    assert failures == {
        "circle/hen/10": f"it needs {runs}/egg/10; they need each other",
        "circle/egg/10": f"it needs {runs}/hen/10; they need each other",
        "circle/hen/10/evaluations/own": f"it needs {runs}/hen/10, which failed",
        "circle/egg/10/evaluations/own": f"it needs {runs}/egg/10, which failed",
    }
    needs = {"a": "b", "b": "c", "c": "a", "d": "a", "e": "d"}
    tasks = [Task("", "train", runs / name, runs, (), (runs / need,)) for name, need in needs.items()]
    schedule = Schedule(tasks, runs)
    assert [task.folder.name for task, _, _ in schedule.stuck()] == ["a", "b", "c"]
    assert [task.folder.name for task in schedule.waiting] == ["d", "e"]


def test_a_mistake_is_one_line_and_a_list_a_table(source: Path, tmp_path: Path, called: Any) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "quick/lqr").mkdir(parents=True)
    (tmp_path / "quick/lqr/lqr").write_text("a file where a folder should be")
    for words, code, complaint in (
        ("toys", 2, "toys: there is no such study; did you mean toy?"),
        ("--jobs 0", 2, "--jobs 0: give at least 1"),
        ("--size huge", 2, "--size huge: give quick"),
        (f"--list --studies {tmp_path}", 2, f"{tmp_path}: it holds no study"),
        (f"toy --studies {source}/toy.yaml", 2, f"{source}/toy.yaml: there is no such folder of studies"),
        (
            f"lqr --folder {tmp_path}/file",
            2,
            f"{tmp_path}/file/quick: this path, or a part of it, is a file; give another folder",
        ),
        (
            f"lqr --folder {tmp_path}",
            1,
            f"lqr/lqr/10 failed: {tmp_path}/quick/lqr/lqr/10: this path, or a part of it, is a file; "
            "give another folder",
        ),
    ):
        said = called(*words.split())
        assert (said.code, said.complaint) == (code, f"scripts/reproduce: {complaint}")
    heading, *rows = called("--list").out.splitlines()
    assert re.split(r" {2,}", heading) == ["study", "figure or section", "question"]
    assert sorted(row.split()[0] for row in rows) == sorted(STUDIES)
