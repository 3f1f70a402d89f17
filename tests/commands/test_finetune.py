"""Fine-tuning over the real path: an emulated cart behind its port, one process drives, one learns."""

import json
import os
import shutil
import signal
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import FINETUNING, Outcome, console_script, in_process, interrupt_after, outcome
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from cartpole_rl.errors import PortError
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    TrainingCheckpoint,
    load_agent,
    load_training,
    save_agent,
    save_training,
)
from cartpole_rl.run_folder import write_config
from cartpole_rl.workflows.build import trained_agent
from cartpole_rl.workflows.config import FinetuneConfig, load_settings
from cartpole_rl.workflows.finetuning_cart import FinetuningFiles


def test_every_episode_is_on_disk_once(tuned: tuple[Path, Outcome]) -> None:
    run, _ = tuned
    assert [*contents(run)] == ["after_000.csv", "before_000.csv", "tune_000.csv", "tune_001.csv"]
    assert all(read_recording(path).episode.steps > 1 for path in (run / "recordings").iterdir())


def test_the_better_policy_is_kept_and_reported(tuned: tuple[Path, Outcome]) -> None:
    run, done = tuned
    compared = json.loads((run / "comparison.json").read_text())
    after, before = (compared[stage]["score"]["mean"] for stage in ("after", "before"))
    better = "after" if after >= before else "before"
    assert compared["kept"] == better
    assert f"kept: the policy {better} fine-tuning" in done.out
    other = "before" if better == "after" else "after"
    assert f"; the other one is checkpoints/{other}.pt\n" in done.out
    assert load_agent(run / f"checkpoints/{other}.pt").score == min(after, before)
    assert trained_agent(run).training.seed == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["score"]["mean"] == max(after, before)
    assert metrics["latency_samples"] > 0


def test_tensorboard_shows_cart_and_simulation_side_by_side(tuned: tuple[Path, Outcome]) -> None:
    run, _ = tuned
    steps: dict[str, list[int]] = defaultdict(list)
    for file in sorted(run.glob("events*")):
        for event in EventFileLoader(str(file)).Load():
            for value in event.summary.value:
                steps[value.tag].append(event.step)
    assert steps["cart/score_before"] == [1]
    assert steps["cart/score_tune"] == [2, 3]
    assert steps["cart/score_after"] == [4]
    assert steps["cart/score_in_simulation"] == [1, 2, 3]
    assert steps["link/late_ticks"] == [1, 2, 3, 4]


def test_one_that_has_ended_has_no_state_to_resume(tuned: tuple[Path, Outcome], tmp_path: Path) -> None:
    run, _ = tuned
    names = {path.name for path in (run / "checkpoints").iterdir()}
    assert names in ({"last.pt", "before.pt"}, {"last.pt", "after.pt"})
    done = in_process("finetune", f"resume={run}", "hydra.run.dir=other", folder=tmp_path)
    assert done.code == 2
    assert "leave out hydra.run.dir" in done.complaint
    assert not (tmp_path / "other").exists()


@pytest.mark.usefixtures("without_pictures")
def test_a_tuned_agent_is_evaluated_like_any_other(tuned: tuple[Path, Outcome], tmp_path: Path) -> None:
    run, _ = tuned
    done = in_process("evaluate", f"run={run}", "episodes=2", folder=tmp_path)
    assert done.code == 0, done.err


@pytest.mark.nightly  # workflows/test_finetuning.py resumes one in every run
@pytest.mark.parametrize("is_killed", [True, False], ids=["killed", "interrupted, its learner lost"])
def test_a_run_continues_after_each_kind_of_interruption(
    is_killed: bool, trained: Path, tmp_path: Path
) -> None:
    """The agent that it started from has gone; an interrupted one is as of a learner on a lost machine."""
    run, agent = tmp_path / "run", shutil.copytree(trained, tmp_path / "agent")
    number = 0 if is_killed else 1  # of the last episode before
    words = (f"run={agent}", *FINETUNING, f"episodes={number + 2}", f"hydra.run.dir={run}")
    last = run / f"recordings/tune_00{number}.csv"
    if is_killed:
        process = console_script("finetune", *words, folder=tmp_path)
        while not last.exists():
            assert process.poll() is None, process.communicate()
            time.sleep(0.02)
        os.kill(process.pid, signal.SIGKILL)
        assert outcome(process).code == -signal.SIGKILL
    else:
        interrupt_after(last)
        assert in_process("finetune", *words, folder=tmp_path).code == 130
        lose_the_learner(run)
    shutil.rmtree(agent)
    before = contents(run)
    assert last.name == [*before][-1]
    again = (f"resume={run}", "learner=local")
    done = in_process("finetune", *again, "seed=1", folder=tmp_path)
    assert done.code == 2
    assert done.complaint.endswith("resume uses that run's own config; leave out seed=1")
    done = in_process("finetune", *again, folder=tmp_path)
    assert done.code == 0, done.err
    ended = contents(run)
    assert {name: ended[name] for name in before} == before
    tuned = [f"tune_00{each}.csv" for each in range(number + 2)]
    assert [*ended] == ["after_000.csv", "before_000.csv", *tuned]


def contents(run: Path) -> dict[str, bytes]:
    """The recordings of a run, in the order of their names."""
    return {path.name: path.read_bytes() for path in sorted((run / "recordings").iterdir())}


def lose_the_learner(run: Path) -> None:
    """Let the checkpoint of a run be that of one whose learner was on another machine."""
    saved = load_training(run, FINETUNING_FORMAT)
    learner = {"kind": "ray", "address": "gone:6379", "episodes_ahead": 5, "timeout": 10.0}
    state = {"agent": saved.state["agent"], "learner": "name"}
    config = {**saved.config, "learner": learner}
    save_training(run, TrainingCheckpoint(config, state, saved.step), FINETUNING_FORMAT)


def unfinished(run: Path, agent: Path, is_compiled: bool) -> None:
    """Write the run folder of a fine-tuning on a real cart that has driven no episode."""
    words = {"run": str(agent), "compile": is_compiled, "plant": "serial", "plant.port": "/dev/first"}
    config = load_settings(FinetuneConfig, words)
    write_config(run, "finetune", config.model_dump(mode="json"), agent=agent / "checkpoints/last.pt")
    FinetuningFiles(run, config).save({}, 0)


def test_a_resumed_run_reaches_its_cart_on_another_port(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And an error of the cart says how the run goes on."""
    unfinished(tmp_path / "run", trained, is_compiled=False)
    words = (
        "resume=run",
        "plant.port=/dev/gone",
        "plant.clear_faults=3",
        "plant.home_timeout=200",
        "view=none",
    )

    def fail(files: FinetuningFiles, *_: object) -> None:
        plant = files.config.plant
        raise PortError(f"{plant.port} {plant.clear_faults} {plant.home_timeout} {plant.timeout}")

    monkeypatch.setattr("cartpole_rl.workflows.finetune.drive_all", fail)
    done = in_process("finetune", *words, folder=tmp_path)
    hint = "cartpole-finetune resume=run continues it"
    assert done.complaint == f"cartpole-finetune: /dev/gone 3 200.0 1.0; {hint}"
    assert done.code == 1
    done = in_process("finetune", "resume=run", "plant.timeout=2", folder=tmp_path)
    assert done.complaint.endswith("resume uses that run's own config; leave out plant.timeout=2")
    done = in_process("finetune", "resume=other", "plant.port=/dev/gone", folder=tmp_path)
    assert (
        done.complaint
        == "cartpole-finetune: resume=other: there is no such folder; give the run folder of a training"
    )


def test_what_a_resumed_run_compiles_with_is_missed_before_the_cart_moves(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unfinished(tmp_path / "run", trained, is_compiled=True)
    shutil.copy(trained / "checkpoints/last.pt", tmp_path / "run/checkpoints/start.pt")
    monkeypatch.setenv("CXX", "no-such-compiler")
    done = in_process("finetune", "resume=run", folder=tmp_path)
    assert "compile=true finds no C++ compiler no-such-compiler" in done.complaint


def test_what_the_simulation_reads_is_missed_before_the_cart_moves(trained: Path, tmp_path: Path) -> None:
    """An agent trained on an identified cart, whose files stayed on another computer."""
    agent = load_agent(trained)
    randomization = {"posterior": f"{tmp_path}/posterior.npz", "widen": 1.0, "prior_share": 0.0, "ranges": {}}
    save_agent(tmp_path / "agent.pt", replace(agent, config={**agent.config, "randomization": randomization}))
    words = (f"run={tmp_path}/agent.pt", *FINETUNING, f"hydra.run.dir={tmp_path}/run")
    done = in_process("finetune", *words, folder=tmp_path)
    assert f"randomization.posterior={tmp_path}/posterior.npz cannot be read" in done.complaint
    assert done.code == 2
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("run=null",), "run"),
        (("plant=simulated",), "plant=simulated: this command takes emulated, serial"),
        (("plant=text", "plant.port=x"), "plant.full is missing; give plant.full=<what the board takes at"),
        (
            ("finetuning.buffer_kind=prioritized",),
            "finetuning.buffer_kind=uniform, or finetuning.cart_share=0",
        ),
        (
            ("learner=ray", "learner.address=server:6379"),
            'learner=ray needs Ray: pip install "cartpole_rl[ray]"',
        ),
    ],
)
def test_a_run_a_cart_and_a_learner_are_needed(
    words: tuple[str, ...], complaint: str, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cartpole_rl.workflows.checks.find_spec", lambda name: None)  # nothing is installed
    words = (*FINETUNING[1:], *(words if "run=null" in words else (f"run={trained}", *words)))
    done = in_process("finetune", *words, "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 2
    assert complaint in done.complaint
    assert not (tmp_path / "run").exists()
