"""A study at toy size: it runs, is killed, resumes; a failed run does not end the others."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from command_line import TINY, Outcome, outcome

from cartpole_rl.files import claimed
from cartpole_rl.reporting.studies.settings import Study
from cartpole_rl.workflows.pages.runs import read_run
from cartpole_rl.workflows.reproduce.plan import Task, plan
from cartpole_rl.workflows.reproduce.process import is_complete, made_otherwise, prepare
from cartpole_rl.workflows.reproduce.reproduce import Schedule, reproduce
from cartpole_rl.workflows.run_inputs import is_outdated

SCRIPT = Path(__file__).parents[2] / "scripts/reproduce.py"
ARMS = [
    {"name": "trained", "label": "trained"},
    {"name": "impossible", "label": "impossible", "overrides": ["cart.cart_mass=-1"]},
    {"name": "lqr", "label": "energy and LQR", "overrides": ["run=lqr"]},
]
STUDY = {
    "title": "Toy",
    "order": 1,
    "question": "Does it run?",
    "experiment": "balance",
    "arms": ARMS,
    "evaluations": [{"name": "own", "label": "own"}],
    "sizes": {
        "quick": {
            "seeds": 1,  # forty evaluations: there is time to interrupt it after the first
            "overrides": [*TINY, "learning.transitions=20480", "learning.evaluations=40"],
            "evaluation_overrides": ["episodes=2"],
        }
    },
}
SHARED = [{"name": "shared", "label": "shared", "overrides": ["run={runs}/toy/trained/{seed}"]}]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two studies."""
    folder = tmp_path_factory.mktemp("study")
    for name, content in {"toy": STUDY, "sharing": {**STUDY, "arms": SHARED}}.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return folder


def start(source: Path, folder: Path, *words: str) -> "subprocess.Popen[str]":
    """scripts/reproduce, just started."""
    command = [sys.executable, SCRIPT, *words, "--studies", source, "--folder", folder, "--jobs", "2"]
    return subprocess.Popen(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def script(*words: str) -> Outcome:
    """scripts/reproduce with `words`."""
    command = [sys.executable, str(SCRIPT), *words]
    return outcome(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))


@pytest.fixture(scope="module")
def results(source: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome, Outcome]:
    """The folder of a study that was interrupted and continued, and both outcomes."""
    folder = tmp_path_factory.mktemp("runs")
    process = start(source, folder, "toy")
    checkpoint = folder / "quick/toy/trained/10/checkpoints/resume.pt"
    while not checkpoint.exists() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    stopped = outcome(process)
    return folder / "quick", stopped, outcome(start(source, folder, "toy"))


def test_an_interruption_says_how_to_go_on(results: tuple[Path, Outcome, Outcome]) -> None:
    assert results[1].code == 130
    assert results[1].err.splitlines()[-1] == "scripts/reproduce: interrupted; the same command continues"


def test_the_same_command_resumes(results: tuple[Path, Outcome, Outcome]) -> None:
    run = results[0] / "toy/trained/10"
    assert "resumed" in json.loads((run / "provenance.json").read_text())
    assert len(json.loads((run / "evaluations/own/metrics.json").read_text())["episodes"]) == 2
    assert not (run / "checkpoints/resume.pt").exists()
    assert sum(path.stat().st_size for path in run.rglob("*") if path.is_file()) < 5e6


def test_a_failure_does_not_end_the_others(results: tuple[Path, Outcome, Outcome]) -> None:
    root, _, done = results
    assert done.code == 1
    reasons = [line for line in done.err.splitlines() if line.startswith("scripts/reproduce: ")]
    assert reasons == [
        "scripts/reproduce: toy/impossible/10 failed: cart_mass is -1; it must be above 0",
        "scripts/reproduce: toy/impossible/10/evaluations/own failed: "
        f"it needs {root}/toy/impossible/10, which failed",
    ]
    assert (root / "toy/lqr/10/evaluations/own/metrics.json").exists()


def test_the_baseline_is_evaluated_again_without_its_other_evaluations(
    results: tuple[Path, Outcome, Outcome], source: Path
) -> None:
    (baseline,) = (
        task for task in plan(["toy"], "quick", results[0], source) if task.folder.parts[-2] == "lqr"
    )
    kept = baseline.folder / "evaluations/own/metrics.json"
    content = kept.read_bytes()
    assert not prepare(baseline)
    assert [path.name for path in baseline.folder.iterdir()] == ["evaluations"]
    assert kept.read_bytes() == content
    assert reproduce(["toy"], "quick", results[0], 1, source, lambda line: None).keys() == {
        "toy/impossible/10",
        "toy/impossible/10/evaluations/own",
    }
    assert is_complete(baseline)


def test_two_at_once_do_not_share_a_folder(results: tuple[Path, Outcome, Outcome], source: Path) -> None:
    with claimed(results[0]):
        done = outcome(start(source, results[0].parent, "toy"))
    assert done.code == 2
    assert "scripts/reproduce: another process works in" in done.err


def test_a_fine_tuning_is_complete_with_its_comparison(tmp_path: Path) -> None:
    task = Task("toy", "finetune", tmp_path, tmp_path, ())
    (tmp_path / "metrics.json").write_text("{}")
    assert not is_complete(task)
    (tmp_path / "comparison.json").write_text("{}")
    assert is_complete(task)


def test_a_line_for_each_run_counts_and_estimates(results: tuple[Path, Outcome, Outcome]) -> None:
    lines = [line for line in results[2].out.splitlines() if line.startswith("[")]
    assert [line.split("]")[0] for line in lines] == [f"[{n}/{len(lines)}" for n in range(1, len(lines) + 1)]
    assert any(line.endswith("left") for line in lines)


def test_the_study_is_written_with_its_size(results: tuple[Path, Outcome, Outcome]) -> None:
    written = Study(**yaml.safe_load((results[0] / "toy/study.yaml").read_text()))
    assert (written.size, written.title) == ("quick", "Toy")


def test_an_agent_of_another_study_is_not_trained_again(
    results: tuple[Path, Outcome, Outcome], source: Path
) -> None:
    root = results[0]
    done = outcome(start(source, root.parent, "sharing"))
    assert done.code == 0, done.err
    assert done.out.startswith("2 runs, 1 of them done; 2 at a time")
    evaluated = yaml.safe_load((root / "sharing/shared/10/evaluations/own/config.yaml").read_text())
    assert evaluated["run"] == str(root / "toy/trained/10")


def test_an_evaluation_of_an_agent_that_was_trained_again_is_repeated_and_does_not_count(
    results: tuple[Path, Outcome, Outcome], source: Path
) -> None:
    trained, evaluation = plan(["toy"], "quick", results[0], source)[:2]
    checkpoint = trained.folder / "checkpoints/last.pt"
    content = checkpoint.read_bytes()
    assert not is_outdated(evaluation.folder)
    assert not read_run(evaluation.folder).problem
    checkpoint.write_bytes(content + b"again")
    assert is_outdated(evaluation.folder)
    assert read_run(evaluation.folder).problem.startswith("a run that it needs was made again")
    checkpoint.rename(trained.folder / "away")
    assert not is_outdated(evaluation.folder)
    (trained.folder / "metrics.json").rename(trained.folder / "no_metrics")
    waiting = Schedule([trained, evaluation], results[0]).waiting
    assert waiting == [trained, evaluation]  # the agent that will be trained is another one
    (trained.folder / "no_metrics").rename(trained.folder / "metrics.json")
    checkpoint.write_bytes(content)
    assert Schedule([trained, evaluation], results[0]).waiting == []


def test_an_incomplete_or_another_run_is_not_taken_for_complete(
    results: tuple[Path, Outcome, Outcome], source: Path
) -> None:
    root = results[0]
    trained, evaluation = plan(["toy"], "quick", root, source)[:2]
    assert is_complete(trained)
    assert is_complete(evaluation)
    assert not made_otherwise(evaluation)
    elsewhere = plan(["toy"], "quick", root.resolve() / ".." / root.name, source)[1]
    assert not made_otherwise(replace(elsewhere, folder=evaluation.folder))
    assert made_otherwise(replace(evaluation, words=("episodes=7",))).startswith("it was made with other")
    metrics = json.loads((evaluation.folder / "metrics.json").read_text())
    del metrics["episodes"][-1]  # as after Ctrl-C
    (evaluation.folder / "metrics.json").write_text(json.dumps(metrics))
    assert not is_complete(evaluation)


def test_a_study_of_other_settings_keeps_its_file_and_gets_no_more_runs(
    results: tuple[Path, Outcome, Outcome], tmp_path: Path
) -> None:
    root = tmp_path / "quick"
    shutil.copytree(results[0] / "toy", root / "toy")
    old = (root / "toy/study.yaml").read_text()
    sizes = {"quick": {"seeds": 2, "overrides": TINY, "evaluation_overrides": ["episodes=2"]}}
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump({**STUDY, "arms": [ARMS[2]], "sizes": sizes}))
    evaluation = root / "toy/lqr/10/evaluations/own"
    record = json.loads((evaluation / "provenance.json").read_text())
    (evaluation / "provenance.json").write_text(json.dumps({**record, "command": ["", "knock=8"]}))
    lines: list[str] = []
    failures = reproduce(["toy"], "quick", root, 1, tmp_path, lines.append)
    assert lines[0] == f"4 runs, 1 of them done, 3 refused; 1 at a time, in {root}"
    assert failures["toy/lqr/10/evaluations/own"].startswith("it was made with other settings")
    assert failures["toy/lqr/11"] == "other runs of its study were made with other settings"
    assert (root / "toy/study.yaml").read_text() == old


def test_a_wrong_name_is_one_line(source: Path, tmp_path: Path) -> None:
    done = outcome(start(source, tmp_path, "toys"))
    assert done.code == 2
    assert done.complaint == "scripts/reproduce: toys: there is no such study; did you mean toy?"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--jobs", "0"), "--jobs 0: give at least 1"),
        (("--jobs", "-2"), "--jobs -2: give at least 1"),
        (("--size", "huge"), "--size huge: give quick"),
    ],
    ids=" ".join,
)
def test_a_wrong_option_is_one_line(words: tuple[str, ...], complaint: str, source: Path) -> None:
    done = script(*words, "--studies", str(source))
    assert (done.complaint, done.code) == (f"scripts/reproduce: {complaint}", 2)


def test_a_file_instead_of_the_folder_of_studies_is_one_line(source: Path) -> None:
    done = script("toy", "--studies", str(source / "toy.yaml"))
    complaint = f"scripts/reproduce: {source / 'toy.yaml'}: there is no such folder of studies"
    assert (done.complaint, done.code) == (complaint, 2)


def test_a_folder_without_studies_is_one_line(tmp_path: Path) -> None:
    done = script("--list", "--studies", str(tmp_path))
    assert (done.complaint, done.code) == (f"scripts/reproduce: {tmp_path}: it holds no study", 2)


def test_the_list_is_a_table_of_all_studies(source: Path) -> None:
    lines = script("--list", "--studies", str(source)).out.splitlines()
    assert re.split(r" {2,}", lines[0]) == ["study", "figure or section", "question"]
    assert [line.split()[0] for line in lines[1:]] == ["sharing", "toy"]


def test_runs_wait_for_those_that_they_need(source: Path, tmp_path: Path) -> None:
    schedule = Schedule(plan(["sharing"], "quick", tmp_path, source), tmp_path)
    (first,) = schedule.ready(5)
    assert first.folder == tmp_path / "toy/trained/10"
    schedule.finish(first, "")
    evaluation = tmp_path / "sharing/shared/10/evaluations/own"
    assert [task.folder for task in schedule.ready(5)] == [evaluation]
