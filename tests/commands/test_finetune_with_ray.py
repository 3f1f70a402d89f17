"""A fine-tuning whose learner is on another node of a Ray cluster equals one on a single machine."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from command_line import FINETUNING, Outcome, in_process, interrupt

from cartpole_rl.learning.checkpoints import (
    FINETUNING_FORMAT,
    TrainingCheckpoint,
    load_training,
    save_training,
)
from cartpole_rl.workflows.ray_learner.node import SETTINGS

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason='needs Ray: pip install "cartpole_rl[ray]"')


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a Ray head that offers a learner."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    log = tmp_path_factory.mktemp("ray") / "head.log"
    words = ["start", "--head", "--block", "--node-ip-address=127.0.0.1", f"--port={port}"]
    limits = ["--num-cpus=1", "--object-store-memory=100000000", "--include-dashboard=false"]
    command = [sys.executable, "-m", "ray.scripts.scripts", *words, *limits, '--resources={"learner": 1}']
    with log.open("wb") as output:
        started = subprocess.Popen(command, env={**os.environ, **SETTINGS}, stdout=output, stderr=output)
    try:
        while "Ray runtime started" not in log.read_text():
            assert started.poll() is None, log.read_text()
            time.sleep(0.5)
        yield f"127.0.0.1:{port}"
    finally:
        started.send_signal(signal.SIGTERM)
        started.wait()


@needs_ray
def test_it_equals_one_on_a_single_machine_to_the_bit(
    trained: Path, tuned: tuple[Path, Outcome], head: str, tmp_path: Path
) -> None:
    alone, _ = tuned
    words = (*FINETUNING, "learner=ray", f"learner.address={head}", "hydra.run.dir=run")
    done = in_process("finetune", f"run={trained}", *words, folder=tmp_path)
    assert done.code == 0, done.err
    assert "connected to the learner" in done.err
    for recording in sorted((alone / "recordings").iterdir()):
        assert (tmp_path / "run/recordings" / recording.name).read_bytes() == recording.read_bytes()
    expected, found = (
        torch.load(run / "checkpoints/last.pt", weights_only=True)["weights"]
        for run in (alone, tmp_path / "run")
    )
    assert all(torch.equal(weight, found[name]) for name, weight in expected.items())
    assert [path.name for path in (tmp_path / "run/checkpoints").iterdir()] == ["last.pt"]


@needs_ray
@pytest.mark.parametrize("listens", [False, True])
def test_an_address_without_a_cluster_is_refused_before_the_cart_moves(
    listens: bool, trained: Path, tmp_path: Path
) -> None:
    reason = "timed out" if listens else "Connection refused"
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        if not listens:
            server.close()
        words = (*FINETUNING, "learner=ray", f"learner.address={address}", "hydra.run.dir=run")
        done = in_process("finetune", f"run={trained}", *words, folder=tmp_path)
    assert done.code == 1
    refused = (
        rf"the learner at learner\.address={re.escape(address)} does not answer \(.*({reason}).*\); start"
    )
    assert re.search(refused, done.err)
    assert not (tmp_path / "run/recordings").exists()


def test_a_run_that_lost_its_learner_continues_on_one_machine(trained: Path, tmp_path: Path) -> None:
    """Its checkpoint holds the newest weights alone."""
    run = tmp_path / "run"
    interrupt(tmp_path, "tune_001.csv", signal.SIGINT)
    words = (*FINETUNING, "episodes=3", "hydra.run.dir=run")
    assert in_process("finetune", f"run={trained}", *words, folder=tmp_path).code == 130
    saved = load_training(run, FINETUNING_FORMAT)
    assert saved.step >= 1
    elsewhere = {"kind": "ray", "address": "gone:6379", "episodes_ahead": 5, "timeout": 10.0}
    weights = {"agent": saved.state["agent"], "learner": "name"}
    left = TrainingCheckpoint({**saved.config, "learner": elsewhere}, weights, saved.step)
    save_training(run, left, FINETUNING_FORMAT)

    done = in_process("finetune", f"resume={run}", "learner=local", "seed=1", folder=tmp_path)
    assert done.code == 2
    assert done.complaint.endswith("resume uses that run's own config; leave out seed=1")
    done = in_process("finetune", f"resume={run}", "learner=local", folder=tmp_path)
    assert done.code == 0, done.err
    assert len(list((run / "recordings").glob("tune_*.csv"))) == 3
    assert (run / "metrics.json").exists()


@pytest.mark.skipif(find_spec("ray") is not None, reason="Ray is installed")
def test_without_ray_the_extra_is_named(trained: Path, tmp_path: Path) -> None:
    words = (*FINETUNING, "learner=ray", "learner.address=server:6379", "hydra.run.dir=run")
    done = in_process("finetune", f"run={trained}", *words, folder=tmp_path)
    assert done.code == 2
    assert 'learner=ray needs Ray: pip install "cartpole_rl[ray]"' in done.complaint


@pytest.mark.parametrize("address", ["server", "ray://server:10001", "server:637900", ""])
def test_an_address_has_a_host_and_a_port(address: str, trained: Path, tmp_path: Path) -> None:
    words = ("learner=ray", f"learner.address={address}", "hydra.run.dir=run")
    done = in_process("finetune", f"run={trained}", *words, folder=tmp_path)
    assert done.code == 2
    assert "learner.address" in done.complaint
