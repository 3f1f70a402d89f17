"""A study at toy size: it is interrupted and continued, and a failed run does not end the others.

Runs that were made with other settings, or of an agent that was trained again, do not count as done.
"""

import errno
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
import reproduce as script
import yaml
from command_line import TINY, Outcome, outcome
from plan import Task, plan
from reproduce import Progress, Schedule, failure_of, reproduce
from study import Study
from worker import carry_out, finish, is_complete, made_otherwise, prepare, reason_of

from cartpole_rl.errors import ConfigError
from cartpole_rl.files import claimed
from cartpole_rl.workflows import report, train
from cartpole_rl.workflows.pages.runs import read_run
from cartpole_rl.workflows.run_folder import recorded_provenance
from cartpole_rl.workflows.run_inputs import is_outdated

CHECKOUT = Path(script.__file__).parents[2]
ARMS = [
    {"name": "trained", "label": "trained"},
    {"name": "impossible", "label": "impossible", "overrides": ["cart.cart_mass=-1"]},
    {"name": "lqr", "label": "energy and LQR", "overrides": ["run=lqr"]},
]
OVERRIDES = [*TINY, "learning.transitions=20480", "learning.evaluations=10"]  # there is time to interrupt it
STUDY: dict[str, Any] = {
    "title": "Toy",
    "order": 1,
    "question": "Does it run?",
    "experiment": "balance",
    "arms": ARMS,
    "evaluations": [{"name": "own", "label": "own"}],
    "sizes": {"quick": {"seeds": 1, "overrides": OVERRIDES, "evaluation_overrides": ["episodes=1"]}},
}
SHARED = [{"name": "shared", "label": "shared", "overrides": ["run={runs}/toy/trained/{seed}"]}]
HEN_AND_EGG = {
    **STUDY,
    "command": "finetune",
    "arms": [
        {"name": "hen", "label": "hen", "overrides": ["run={runs}/circle/egg/{seed}"]},
        {"name": "egg", "label": "egg", "overrides": ["run={runs}/circle/hen/{seed}"]},
    ],
}
STUDIES = {
    "toy": STUDY,
    "sharing": {**STUDY, "arms": SHARED},
    "short": {
        **STUDY,
        "arms": ARMS[:1],
        "evaluations": [],
        "sizes": {"quick": {"seeds": 1, "overrides": [*TINY]}},
    },
    "lqr": {**STUDY, "arms": ARMS[2:], "evaluations": []},
    "circle": HEN_AND_EGG,
}
PARENT = """
import multiprocessing, sys, time, worker
worker.finish = lambda task: time.sleep(600)
process = multiprocessing.get_context("fork").Process(target=worker.in_own_process, args=(None, None))
process.start()
print(process.pid, flush=True)
time.sleep(600)
"""


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of studies."""
    folder = tmp_path_factory.mktemp("study")
    for name, content in STUDIES.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return folder


def start(caller: Path, *words: object) -> "subprocess.Popen[str]":
    """scripts/reproduce of a caller in a folder, just started."""
    command = [sys.executable, script.__file__, *map(str, words)]
    return subprocess.Popen(command, cwd=caller, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Call scripts/reproduce in this process with words."""

    def call(*words: object) -> Outcome:
        monkeypatch.chdir(Path.cwd())  # the script changes it
        monkeypatch.setattr(sys, "argv", ["scripts/reproduce", *map(str, words)])
        with monkeypatch.context() as patched:
            patched.setattr(script, "RaiseOnce", lambda raised: type("None", (), {"handle": lambda *_: None}))
            code = script.main()
        return Outcome(code, *capsys.readouterr())

    return call


@pytest.fixture(scope="module")
def results(
    source: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Outcome, dict[str, str], list[str]]:
    """The folder of an interrupted and continued study, the first outcome, then failures and lines."""
    folder = tmp_path_factory.mktemp("my #runs")
    process = start(folder.parent, "toy", "--studies", source, "--folder", folder.name, "--jobs", 2)
    checkpoint = folder / "quick/toy/trained/10/checkpoints/resume.pt"
    while not checkpoint.exists() and process.poll() is None:
        time.sleep(0.01)
    started = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    stopped = outcome(process)
    assert psutil.wait_procs(started, timeout=60)[1] == []
    lines: list[str] = []
    failures = reproduce(["toy"], "quick", folder / "quick", 2, source, lines.append)
    return folder / "quick", stopped, failures, lines


def test_an_interrupted_reproduction_is_continued(
    results: tuple[Path, Outcome, dict[str, str], list[str]],
) -> None:
    root, stopped, failures, lines = results
    assert stopped.code == 130
    assert stopped.err.splitlines()[-1] == "scripts/reproduce: interrupted; the same command continues"
    run = root / "toy/trained/10"
    assert "interrupted" in (run / "log.txt").read_text().splitlines()
    assert "resumed" in json.loads((run / "provenance.json").read_text())
    assert not (run / "checkpoints/resume.pt").exists()
    assert failures == {
        "toy/impossible/10": "cart_mass is -1; it must be above 0",
        "toy/impossible/10/evaluations/own": f"it needs {root}/toy/impossible/10, which failed",
    }
    for arm in ("trained", "lqr"):
        assert (
            len(json.loads((root / f"toy/{arm}/10/evaluations/own/metrics.json").read_text())["episodes"])
            == 1
        )
    assert re.match(r"6 runs, \d of them done; 2 at a time, in ", lines[0])
    numbered = [line.split("]")[0] for line in lines if line.startswith("[")]
    assert numbered == [f"[{number}/{len(numbered)}" for number in range(1, len(numbered) + 1)]
    assert any(line.endswith(" left") for line in lines)
    written = Study(**yaml.safe_load((root / "toy/study.yaml").read_text()))
    assert (written.size, written.title) == ("quick", "Toy")


def test_an_agent_of_another_study_is_not_trained_again(
    results: tuple[Path, Any, Any, Any], source: Path
) -> None:
    root, lines = results[0], []
    schedule = Schedule(plan(["sharing"], "quick", root.with_name("none"), source), root.with_name("none"))
    (first,) = schedule.ready(5)
    assert first.folder.parts[-3:] == ("toy", "trained", "10")
    schedule.finish(first, "")
    assert [task.study for task in schedule.ready(5)] == ["sharing"]  # runs wait for those that they need
    assert reproduce(["sharing"], "quick", root, 2, source, lines.append) == {}
    assert lines[0].startswith("2 runs, 1 of them done; 2 at a time")
    evaluated = yaml.safe_load((root / "sharing/shared/10/evaluations/own/config.yaml").read_text())
    assert evaluated["run"] == str(root / "toy/trained/10")


def test_the_baseline_is_evaluated_again_without_its_other_evaluations(
    results: tuple[Path, Any, Any, Any], source: Path
) -> None:
    (baseline,) = (
        task for task in plan(["toy"], "quick", results[0], source) if task.folder.parts[-2] == "lqr"
    )
    kept = baseline.folder / "evaluations/own/metrics.json"
    content = kept.read_bytes()
    assert not prepare(baseline)
    assert [path.name for path in baseline.folder.iterdir()] == ["evaluations"]
    assert kept.read_bytes() == content


def test_only_complete_runs_of_the_same_settings_and_agent_are_done(
    results: tuple[Path, Any, Any, Any], source: Path
) -> None:
    root = results[0]
    trained, evaluation = plan(["toy"], "quick", root, source)[:2]
    assert Schedule([trained, evaluation], root).waiting == []
    assert not made_otherwise(evaluation)
    elsewhere = plan(["toy"], "quick", root.resolve() / ".." / root.name, source)[1]
    assert not made_otherwise(replace(elsewhere, folder=evaluation.folder))
    assert made_otherwise(replace(evaluation, words=("episodes=7",))).startswith("it was made with other")
    checkpoint = trained.folder / "checkpoints/last.pt"
    content = checkpoint.read_bytes()
    checkpoint.write_bytes(content + b"again")
    assert is_outdated(evaluation.folder)
    assert read_run(evaluation.folder).problem.startswith("a run that it needs was made again")
    checkpoint.rename(trained.folder / "away")
    (trained.folder / "metrics.json").rename(trained.folder / "no_metrics")
    waiting = Schedule([trained, evaluation], root).waiting
    assert waiting == [trained, evaluation]  # the agent that will be trained is another one
    (trained.folder / "no_metrics").rename(trained.folder / "metrics.json")
    checkpoint.write_bytes(content)
    metrics = evaluation.folder / "metrics.json"
    whole = metrics.read_text()
    metrics.write_text(json.dumps({**json.loads(whole), "episodes": []}))  # as after Ctrl-C
    assert not is_complete(evaluation)
    metrics.write_text(whole)
    assert is_complete(evaluation)


def test_a_study_of_other_settings_keeps_its_file_and_gets_no_more_runs(
    results: tuple[Path, Any, Any, Any], tmp_path: Path
) -> None:
    root, lines = tmp_path / "quick", []
    shutil.copytree(results[0] / "toy", root / "toy")
    old = (root / "toy/study.yaml").read_text()
    sizes = {"quick": {"seeds": 2, "evaluation_overrides": ["episodes=1"]}}
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump({**STUDY, "arms": [ARMS[2]], "sizes": sizes}))
    evaluation = root / "toy/lqr/10/evaluations/own/provenance.json"
    evaluation.write_text(json.dumps({**json.loads(evaluation.read_text()), "command": ["", "knock=8"]}))
    failures = reproduce(["toy"], "quick", root, 1, tmp_path, lines.append)
    assert "refused; 1 at a time" in lines[0]
    assert failures["toy/lqr/10/evaluations/own"].startswith("it was made with other settings")
    assert failures["toy/lqr/11"] == "other runs of its study were made with other settings"
    assert (root / "toy/study.yaml").read_text() == old


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot fork")
def test_a_run_ends_with_a_killed_reproduction() -> None:
    """The process of a run, whose work is a long sleep here."""
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], cwd=Path(script.__file__).parent, stdout=subprocess.PIPE, text=True
    )
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
        with claimed(task.folder), pytest.raises(ConfigError) as caught:
            finish(task)
        assert str(caught.value) == f"another process works in {task.folder}; wait for its end, or stop it"
        assert (task.folder / "config.yaml").read_text() == "its own"
    with claimed(tmp_path), pytest.raises(ConfigError, match="another process works in"):
        reproduce(["lqr"], "quick", tmp_path, 1, source)


def test_a_training_that_is_killed_after_its_metrics_is_resumed(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(folder: Path) -> None:
        raise KeyboardInterrupt

    (task,) = plan(["short"], "quick", tmp_path, source)
    monkeypatch.setattr(sys, "argv", [])
    with monkeypatch.context() as patched:
        patched.setattr(train, "forget_training", killed)
        with pytest.raises(KeyboardInterrupt):
            carry_out(task)
    assert (task.folder / "metrics.json").exists()
    assert not is_complete(task)
    assert prepare(task)
    carry_out(task, resumed=True)
    assert "resumed" in recorded_provenance(task.folder)
    assert is_complete(task)


def test_an_evaluation_without_its_figures_is_not_complete(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "behaviour.png")

    (task,) = plan(["lqr"], "quick", tmp_path, source)
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(report, "save", full)
    with pytest.raises(OSError, match="No space left"):
        carry_out(task)
    assert not is_complete(task)


@pytest.mark.parametrize(("command", "result"), [("train", "metrics.json"), ("finetune", "comparison.json")])
def test_a_training_with_a_state_to_resume_from_is_not_complete(
    command: str, result: str, tmp_path: Path
) -> None:
    task = Task("toy", command, tmp_path, tmp_path, ())
    assert not is_complete(task)
    (tmp_path / result).write_text("{}")
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/resume.pt").touch()
    assert not is_complete(task)
    (tmp_path / "checkpoints/resume.pt").unlink()
    assert is_complete(task)


def test_a_link_in_an_incomplete_run_is_removed_but_not_what_it_names(tmp_path: Path) -> None:
    (tmp_path / "away").mkdir()
    (tmp_path / "away/file").touch()
    task = Task("toy", "train", tmp_path / "run", tmp_path, ())
    task.folder.mkdir()
    (task.folder / "link").symlink_to(tmp_path / "away")
    assert not prepare(task)
    assert [*task.folder.iterdir()] == []
    assert (tmp_path / "away/file").exists()


@pytest.mark.timeout(120)  # it would never end
def test_runs_that_need_each_other_fail(source: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    failures = reproduce(["circle"], "quick", tmp_path, 1, source, lines.append)
    runs = tmp_path / "circle"
    assert failures == {
        "circle/hen/10": f"it needs {runs}/egg/10; they need each other",
        "circle/egg/10": f"it needs {runs}/hen/10; they need each other",
        "circle/hen/10/evaluations/own": f"it needs {runs}/hen/10, which failed",
        "circle/egg/10/evaluations/own": f"it needs {runs}/egg/10, which failed",
    }
    assert lines[-1].startswith("4 runs in ")

    def run(name: str, *needs: str) -> Task:
        return Task(
            "circle", "train", tmp_path / name, tmp_path, (), tuple(tmp_path / need for need in needs)
        )

    schedule = Schedule([run("a", "b"), run("b", "c"), run("c", "a"), run("d", "a"), run("e", "d")], tmp_path)
    assert schedule.ready(5) == []
    assert [task.folder.name for task, _, _ in schedule.stuck()] == ["a", "b", "c"]
    assert [task.folder.name for task in schedule.waiting] == ["d", "e"]


def test_a_failure_has_a_reason_in_one_line(tmp_path: Path) -> None:
    assert reason_of(ConfigError("two\nlines")) == "two lines"
    assert reason_of(ZeroDivisionError("a\nb")) == "ZeroDivisionError: a b"
    assert reason_of(OSError(errno.ENOSPC, "Full", "a/b")) == "a/b: Full"
    assert reason_of(OSError(errno.ENOSPC, "Full")) == "Full"
    task = Task("toy", "train", tmp_path, tmp_path, ())
    assert failure_of(task, -9, "") == "signal 9 ended its process"
    assert failure_of(task, 1, "it diverged") == "it diverged"
    assert failure_of(task, 1, "") == "exit status 1"
    assert failure_of(task, 0, "").startswith("it ended without all of its results")
    (tmp_path / "metrics.json").touch()
    assert failure_of(task, 0, "") == ""


TRAIN, EVALUATE, OTHER = (
    Task(study, command, Path("runs", study, "arm/10"), Path("runs"), ())
    for study, command in (("toy", "train"), ("toy", "evaluate"), ("other", "train"))
)


@pytest.mark.parametrize(
    ("done", "left", "line"),
    [
        ([(TRAIN, 90, "")], [TRAIN, TRAIN], "2 min, about 2 min left"),
        ([(TRAIN, 90, "")], [OTHER], "2 min, about 45 s left"),
        ([(TRAIN, 90, ""), (OTHER, 10, "")], [TRAIN], "10 s, about 45 s left"),
        ([(EVALUATE, 5, "")], [TRAIN], "5 s"),
        ([(EVALUATE, 6, "")], [TRAIN, EVALUATE], "6 s, at least 3 s left"),
        ([(TRAIN, 1, "it diverged")], [TRAIN], "FAILED: it diverged"),
        ([(EVALUATE, 6, ""), (TRAIN, 1, "it diverged")], [EVALUATE], "FAILED: it diverged, about 3 s left"),
        ([(TRAIN, 90, "")], [], "2 min, about 0 s left"),
    ],
)
def test_the_time_left_is_that_of_similar_runs(
    done: Sequence[tuple[Task, float, str]], left: Sequence[Task], line: str
) -> None:
    lines: list[str] = []
    progress = Progress(9, 2, lines.append)
    for task, seconds, failure in done:
        progress.finished(task, "run", seconds, left, failure)
    assert lines[-1].partition("run: ")[2] == line


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["toys"], "toys: there is no such study; did you mean toy?"),
        (["--jobs", "0"], "--jobs 0: give at least 1"),
        (["--size", "huge"], "--size huge: give quick"),
        (["--list", "--studies", "SOURCE/nothing"], "SOURCE/nothing: it holds no study"),
        (["toy", "--studies", "SOURCE/toy.yaml"], "SOURCE/toy.yaml: there is no such folder of studies"),
    ],
    ids=lambda each: " ".join(each) if isinstance(each, list) else "",
)
def test_a_mistake_is_one_line(words: list[str], complaint: str, source: Path, called: Any) -> None:
    named = [word.replace("SOURCE", str(source)) for word in words]
    done = called("--studies", source, *named)
    assert (done.code, done.complaint) == (
        2,
        f"scripts/reproduce: {complaint.replace('SOURCE', str(source))}",
    )


def test_the_list_is_a_table_of_all_studies(source: Path, called: Any) -> None:
    lines = called("--list", "--studies", source).out.splitlines()
    assert re.split(r" {2,}", lines[0]) == ["study", "figure or section", "question"]
    assert sorted(line.split()[0] for line in lines[1:]) == sorted(STUDIES)


def test_folders_are_those_of_the_caller_and_have_one_name_in_the_checkout(
    results: tuple[Path, Any, Any, Any],
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    called: Any,
) -> None:
    for here, path, name in (
        (CHECKOUT, "runs/x", Path("runs/x")),
        (CHECKOUT / "docs", "x", Path("docs/x")),
        (tmp_path, "x", tmp_path / "x"),
        (tmp_path, f"{CHECKOUT}/x", CHECKOUT / "x"),
    ):
        monkeypatch.chdir(here)
        assert script.as_in_checkout(path) == name
    monkeypatch.chdir(results[0].parents[1])
    done = called("sharing", "--studies", source, "--folder", results[0].parent.name)
    assert (done.code, done.err) == (0, "")
    page = done.out.splitlines()[-1]
    assert page == f"the page: scripts/thesis/report.py '{results[0]}'"


def test_mistakes_of_the_system_are_one_line(source: Path, tmp_path: Path, called: Any) -> None:
    (tmp_path / "file").touch()
    done = called("lqr", "--studies", source, "--folder", tmp_path / "file/runs")
    assert (done.code, done.err) == (1, f"scripts/reproduce: {tmp_path}/file/runs/quick: Not a directory\n")
    (tmp_path / "runs/quick/lqr").mkdir(parents=True)
    (tmp_path / "runs/quick/lqr/lqr").write_text("a file where a folder should be")
    done = called("lqr", "--studies", source, "--folder", tmp_path / "runs")
    where = tmp_path / "runs/quick/lqr/lqr/10"
    assert done.err == f"scripts/reproduce: lqr/lqr/10 failed: {where}: Not a directory\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full is a device of Linux")
def test_a_full_disk_is_one_line(source: Path) -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, script.__file__, "--list", "--studies", str(source)]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert "No space left on device" in done.stderr
    assert done.returncode != 0


def test_the_shell_script_stays_in_the_folder_of_the_caller(tmp_path: Path) -> None:
    copy, python = tmp_path / "checkout/scripts/reproduce", tmp_path / "checkout/.venv/bin/python"
    for file in (copy, python):
        file.parent.mkdir(parents=True)
    shutil.copy(CHECKOUT / "scripts/reproduce", copy)
    python.write_text('#!/bin/sh\npwd\necho "$@"\n')
    python.chmod(0o755)
    done = subprocess.run([copy, "--list"], cwd="/", capture_output=True, text=True)
    assert done.stdout.splitlines() == ["/", f"{copy.parent}/thesis/reproduce.py --list"]
