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
from command_line import FINETUNING, Outcome, console_script, in_process, interrupt, outcome
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    TrainingCheckpoint,
    load_agent,
    load_training,
    save_agent,
    save_training,
)
from cartpole_rl.workflows.build import trained_agent


def recordings(run: Path) -> list[str]:
    return sorted(path.name for path in (run / "recordings").iterdir())


def test_every_episode_is_on_disk_once(tuned: tuple[Path, Outcome]) -> None:
    run, _ = tuned
    assert recordings(run) == ["after_000.csv", "before_000.csv", "tune_000.csv", "tune_001.csv"]
    assert all(read_recording(path).steps > 1 for path in (run / "recordings").iterdir())


def test_the_better_policy_is_kept_and_reported(tuned: tuple[Path, Outcome]) -> None:
    run, done = tuned
    compared = json.loads((run / "comparison.json").read_text())
    better = (
        "after" if compared["after"]["score"]["mean"] >= compared["before"]["score"]["mean"] else "before"
    )
    assert compared["kept"] == better
    assert f"kept: the policy {better} fine-tuning" in done.out
    assert trained_agent(run).training.seed == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["score"]["mean"] == compared[better]["score"]["mean"]
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


def test_one_that_has_ended_is_not_resumed(tuned: tuple[Path, Outcome], tmp_path: Path) -> None:
    run, _ = tuned
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["last.pt"]
    done = in_process("finetune", f"resume={run}", folder=tmp_path)
    assert done.code == 2
    assert f"this run of cartpole-finetune has ended; cartpole-evaluate run={run}" in done.complaint
    done = in_process("finetune", f"resume={run}", "hydra.run.dir=other", folder=tmp_path)
    assert done.code == 2
    assert "leave out hydra.run.dir" in done.complaint
    assert not (tmp_path / "other").exists()


def test_a_tuned_agent_is_evaluated_like_any_other(tuned: tuple[Path, Outcome], tmp_path: Path) -> None:
    run, _ = tuned
    done = in_process(
        "evaluate", f"run={run}", "episodes=2", f"hydra.run.dir={tmp_path}/evaluated", folder=tmp_path
    )
    assert done.code == 0, done.err


def contents(run: Path) -> dict[str, bytes]:
    """The recordings of a run."""
    return {name: (run / "recordings" / name).read_bytes() for name in recordings(run)}


def test_a_run_continues_after_each_kind_of_interruption(trained: Path, tmp_path: Path) -> None:
    """One run: killed, then interrupted, then its checkpoint is as of a learner on a machine that is lost.

    The agent that it started from has gone after the first time.
    """
    run, agent = tmp_path / "run", tmp_path / "agent"
    shutil.copytree(trained, agent)
    words = (f"run={agent}", *FINETUNING, "finetuning.refit=2", "episodes=3", f"hydra.run.dir={run}")
    process = console_script("finetune", *words, folder=tmp_path)
    while not (run / "recordings/tune_000.csv").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    assert outcome(process).code == -signal.SIGKILL
    shutil.rmtree(agent)
    killed = contents(run)
    assert "tune_001.csv" not in killed

    interrupt(tmp_path, "tune_001.csv", signal.SIGINT)
    assert in_process("finetune", f"resume={run}", folder=tmp_path).code == 130
    interrupted = contents(run)
    assert {name: interrupted[name] for name in killed} == killed
    saved = load_training(run, FINETUNING_FORMAT)
    assert saved.step >= 1

    learner = {"kind": "ray", "address": "gone:6379", "episodes_ahead": 5, "timeout": 10.0}
    state = {"agent": saved.state["agent"], "learner": "name"}
    save_training(
        run, TrainingCheckpoint({**saved.config, "learner": learner}, state, saved.step), FINETUNING_FORMAT
    )
    done = in_process("finetune", f"resume={run}", "learner=local", "seed=1", folder=tmp_path)
    assert done.code == 2
    assert done.complaint.endswith("resume uses that run's own config; leave out seed=1")
    done = in_process("finetune", f"resume={run}", "learner=local", folder=tmp_path)
    assert done.code == 0, done.err
    ended = contents(run)
    assert {name: ended[name] for name in interrupted} == interrupted
    assert [*ended] == ["after_000.csv", "before_000.csv", *(f"tune_00{number}.csv" for number in range(3))]


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
