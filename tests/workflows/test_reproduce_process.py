"""A run of a study as a process: it ends with the reproduction, keeps its folder, and says why it fails."""

import errno
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml
from command_line import TINY

from cartpole_rl.errors import ConfigError
from cartpole_rl.files import claimed
from cartpole_rl.workflows import report, train
from cartpole_rl.workflows.reproduce.carry_out import carry_out
from cartpole_rl.workflows.reproduce.plan import Task, plan
from cartpole_rl.workflows.reproduce.process import is_complete, kept, prepare, reason_of
from cartpole_rl.workflows.reproduce.reproduce import failure_of, reproduce
from cartpole_rl.workflows.run_folder import recorded_provenance

SCRIPT = Path(__file__).parents[2] / "scripts/reproduce.py"
STUDY: dict[str, Any] = {
    "title": "Toy",
    "order": 1,
    "question": "Does it run?",
    "experiment": "balance",
    "arms": [{"name": "trained", "label": "trained"}],
    "evaluations": [],
    "sizes": {"quick": {"seeds": 1, "overrides": [*TINY, "learning.evaluations=1"]}},
}
BASELINE = {
    **STUDY,
    "arms": [{"name": "lqr", "label": "energy and LQR", "overrides": ["run=lqr"]}],
    "sizes": {"quick": {"seeds": 1, "evaluation_overrides": ["episodes=1"]}},
}
LONG = {  # minutes: it does not end before it is killed
    **STUDY,
    "sizes": {
        "quick": {
            "seeds": 1,
            "overrides": [*TINY, "learning.transitions=2048000", "learning.evaluations=4000"],
        }
    },
}
WAIT = 60.0  # s


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three studies."""
    folder = tmp_path_factory.mktemp("study")
    for name, content in {"toy": STUDY, "baseline": BASELINE, "long": LONG}.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return folder


def only_run(study: str, root: Path, source: Path) -> Task:
    (task,) = plan([study], "quick", root, source)
    return task


@pytest.fixture
def long_one(source: Path, tmp_path: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """scripts/reproduce in the middle of a long training; at the end nothing of it runs."""
    command = [sys.executable, SCRIPT, "long", "--studies", source, "--folder", tmp_path, "--jobs", "1"]
    process = subprocess.Popen([*map(str, command)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    checkpoint = tmp_path / "quick/long/trained/10/checkpoints/resume.pt"
    while not checkpoint.exists() and process.poll() is None:
        time.sleep(0.01)
    started = psutil.Process(process.pid).children(recursive=True)
    yield process
    process.kill()
    for each in psutil.wait_procs(started, timeout=0)[1]:
        each.kill()


def test_a_run_ends_with_a_killed_reproduction(long_one: "subprocess.Popen[bytes]", tmp_path: Path) -> None:
    children = psutil.Process(long_one.pid).children(recursive=True)
    assert children
    long_one.send_signal(signal.SIGKILL)
    long_one.wait()
    _, alive = psutil.wait_procs(children, timeout=WAIT)
    assert alive == []
    run = tmp_path / "quick/long/trained/10"
    assert (run / "log.txt").read_text().splitlines()[-1] == "interrupted"
    assert (run / "checkpoints/resume.pt").exists()


def test_a_run_that_another_process_writes_is_left_alone(source: Path, tmp_path: Path) -> None:
    for study in ("toy", "baseline"):
        task = only_run(study, tmp_path, source)
        task.folder.mkdir(parents=True)
        (task.folder / "config.yaml").write_text("its own")
        with claimed(task.folder):
            (reason,) = reproduce([study], "quick", tmp_path, 1, source, lambda line: None).values()
        assert reason == f"another process works in {task.folder}; wait for its end, or stop it"
        assert (task.folder / "config.yaml").read_text() == "its own"


def test_an_evaluation_keeps_its_folder(source: Path, tmp_path: Path) -> None:
    task = only_run("baseline", tmp_path, source)
    with kept(task), pytest.raises(ConfigError, match="another process works in"):
        claimed(task.folder).__enter__()


@pytest.mark.parametrize(("command", "result"), [("train", "metrics.json"), ("finetune", "comparison.json")])
def test_a_training_with_a_state_to_resume_from_is_not_complete(
    command: str, result: str, tmp_path: Path
) -> None:
    task = Task("toy", command, tmp_path, tmp_path, ())
    (tmp_path / result).write_text("{}")
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/resume.pt").touch()
    assert not is_complete(task)
    (tmp_path / "checkpoints/resume.pt").unlink()
    assert is_complete(task)


def test_a_training_that_is_killed_after_its_metrics_is_resumed(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(folder: Path) -> None:
        raise KeyboardInterrupt

    task = only_run("toy", tmp_path, source)
    monkeypatch.setattr(sys, "argv", [])
    with monkeypatch.context() as patched:
        patched.setattr(train, "forget_training", killed)
        with pytest.raises(KeyboardInterrupt):
            carry_out(task)
    assert (task.folder / "metrics.json").exists()
    assert reproduce(["toy"], "quick", tmp_path, 1, source, lambda line: None) == {}
    assert "resumed" in recorded_provenance(task.folder)
    assert is_complete(task)


def test_an_evaluation_without_its_figures_is_not_complete(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "behaviour.png")

    task = only_run("baseline", tmp_path, source)
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(report, "save", full)
    with pytest.raises(OSError, match="No space left"):
        carry_out(task)
    assert not is_complete(task)


def test_a_link_in_an_incomplete_run_is_removed_but_not_what_it_names(tmp_path: Path) -> None:
    away = tmp_path / "away"
    away.mkdir()
    (away / "file").touch()
    task = Task("toy", "train", tmp_path / "run", tmp_path, ())
    task.folder.mkdir()
    (task.folder / "link").symlink_to(away)
    assert not prepare(task)
    assert [*task.folder.iterdir()] == []
    assert (away / "file").exists()


def test_a_run_folder_that_cannot_be_made_is_the_reason_of_the_run(source: Path, tmp_path: Path) -> None:
    (tmp_path / "quick/baseline").mkdir(parents=True)
    (tmp_path / "quick/baseline/lqr").write_text("a file where a folder should be")
    command = [sys.executable, SCRIPT, "baseline", "--studies", source, "--folder", tmp_path]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True)
    where = tmp_path / "quick/baseline/lqr/10"
    assert done.stderr == f"scripts/reproduce: baseline/lqr/10 failed: {where}: Not a directory\n"


def test_a_reason_is_one_line() -> None:
    assert reason_of(ConfigError("two\nlines")) == "two lines"
    assert reason_of(ZeroDivisionError("a\nb")) == "ZeroDivisionError: a b"
    assert reason_of(OSError(errno.ENOSPC, "Full", "a/b")) == "a/b: Full"
    assert reason_of(OSError(errno.ENOSPC, "Full")) == "Full"


def test_a_failure_has_a_reason_however_the_process_ended(tmp_path: Path) -> None:
    task = Task("toy", "train", tmp_path, tmp_path, ())
    assert failure_of(task, -9, "") == "signal 9 ended its process"
    assert failure_of(task, 1, "it diverged") == "it diverged"
    assert failure_of(task, 1, "") == "exit status 1"
    assert failure_of(task, 0, "").startswith("it ended without all of its results")
    (tmp_path / "metrics.json").touch()
    assert failure_of(task, 0, "") == ""
    assert failure_of(replace(task, command="finetune"), 0, "") != ""
