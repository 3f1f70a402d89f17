"""Fine-tuning over the real path: an emulated cart behind its port, one process drives, one learns."""

import json
import os
import shutil
import signal
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import torch
from command_line import FINETUNING, ONCE, TINY, Outcome, console_script, in_process, interrupt, outcome
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.learning.checkpoints import load_agent, save_agent
from cartpole_rl.workflows.agents import trained_agent


def finetune(trained: Path, folder: Path, *words: str) -> Outcome:
    return in_process(
        "finetune", f"run={trained}", *FINETUNING, *words, f"hydra.run.dir={folder}/run", folder=folder
    )


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


def test_an_agent_that_observes_the_poles_length_is_tuned(tmp_path: Path) -> None:
    """Its own transitions on the cart have that length; without it every weight would be lost."""
    words = (*TINY, ONCE, "actions=two", "observation=history_length", "hydra.run.dir=trained")
    assert in_process("train", *words, folder=tmp_path).code == 0
    done = finetune(tmp_path / "trained", tmp_path, "emulator.pole_com=0.18")
    assert done.code == 0, done.err
    tuned = torch.load(tmp_path / "run/checkpoints/last.pt", weights_only=True)["weights"]
    assert all(weight.isfinite().all() for weight in tuned.values())
    heading = (tmp_path / "run/recordings/tune_000.csv").read_text()
    assert "# pole_length_m: 0.3600" in heading


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
    """One run: killed, then interrupted, then terminated, each time after one more episode to learn from.

    The agent that it started from has gone after the first time.
    """
    shutil.copytree(trained, tmp_path / "agent")
    words = (
        f"run={tmp_path}/agent",
        *FINETUNING,
        "finetuning.refit=2",
        "episodes=4",
        f"hydra.run.dir={tmp_path}/run",
    )
    process = console_script("finetune", *words, folder=tmp_path)
    while not (tmp_path / "run/recordings/tune_000.csv").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    assert outcome(process).code == -signal.SIGKILL
    kept = contents(tmp_path / "run")
    shutil.rmtree(tmp_path / "agent")
    for recording, stop, code in (
        ("tune_001.csv", signal.SIGINT, 130),
        ("tune_002.csv", signal.SIGTERM, 143),
        (None, None, 0),
    ):
        if recording is not None:
            assert recording not in kept
            interrupt(tmp_path, recording, stop)
        done = in_process("finetune", f"resume={tmp_path}/run", folder=tmp_path)
        assert done.code == code, done.err
        now = contents(tmp_path / "run")
        assert {name: now[name] for name in kept} == kept
        kept = now
    assert recordings(tmp_path / "run") == [
        "after_000.csv",
        "before_000.csv",
        *(f"tune_00{number}.csv" for number in range(4)),
    ]


def test_what_the_simulation_reads_is_missed_before_the_cart_moves(trained: Path, tmp_path: Path) -> None:
    """An agent trained on an identified cart, whose files stayed on another computer."""
    agent = load_agent(trained)
    randomization = {"posterior": f"{tmp_path}/posterior.npz", "widen": 1.0, "prior_share": 0.0, "ranges": {}}
    save_agent(tmp_path / "agent.pt", replace(agent, config={**agent.config, "randomization": randomization}))
    done = finetune(tmp_path / "agent.pt", tmp_path)
    assert f"randomization.posterior={tmp_path}/posterior.npz cannot be read" in done.complaint
    assert done.code == 2
    assert not (tmp_path / "run").exists()


def test_a_run_is_needed(tmp_path: Path) -> None:
    done = in_process("finetune", "run=null", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 2
    assert "run" in done.complaint


def test_it_is_done_on_a_cart(trained: Path, tmp_path: Path) -> None:
    done = in_process("finetune", f"run={trained}", "plant=simulated", "hydra.run.dir=run", folder=tmp_path)
    assert done.code == 2
    assert "plant=simulated: this command takes emulated, serial" in done.complaint
