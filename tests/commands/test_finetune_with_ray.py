"""A fine-tuning whose learner is on another node of a Ray cluster."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from command_line import FINETUNING, Outcome, in_process, interrupt_after

from cartpole_rl.learning.checkpoints import FINETUNING_FORMAT, load_training
from cartpole_rl.workflows.finetune import NAME
from cartpole_rl.workflows.ray_learner import SETTINGS


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, "subprocess.Popen[bytes]"]]:
    """The address and the process of a Ray head that offers a learner."""
    pytest.importorskip("ray")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    folder = tmp_path_factory.mktemp("ray")
    log = folder / "head.log"
    words = ["start", "--head", "--block", "--node-ip-address=127.0.0.1", f"--port={port}"]
    limits = ["--num-cpus=1", "--object-store-memory=100000000", "--include-dashboard=false"]
    command = [sys.executable, "-m", "ray.scripts.scripts", *words, *limits, '--resources={"learner": 1}']
    with log.open("wb") as output:
        started = subprocess.Popen(command, env={**os.environ, **SETTINGS}, stdout=output, stderr=output)
    try:
        while "Ray runtime started" not in log.read_text():
            assert started.poll() is None, log.read_text()
            time.sleep(0.2)
        yield f"127.0.0.1:{port}", started
    finally:
        started.kill()  # its processes end with it
        started.wait()


@pytest.mark.nightly
def test_it_equals_one_on_a_single_machine_to_the_bit(
    trained: Path, tuned: tuple[Path, Outcome], head: tuple[str, "subprocess.Popen[bytes]"], tmp_path: Path
) -> None:
    alone, _ = tuned
    words = (*FINETUNING, "learner=ray", f"learner.address={head[0]}", "hydra.run.dir=run")
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
    alike, kept = (
        sorted(path.name for path in run.glob("checkpoints/*")) for run in (alone, tmp_path / "run")
    )
    assert alike == kept
    assert kept in (["before.pt", "last.pt"], ["after.pt", "last.pt"])


@pytest.mark.nightly  # test_ray_learner.py has the refusal itself
def test_an_address_without_a_cluster_is_refused_before_the_cart_moves(trained: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    words = (*FINETUNING, "learner=ray", f"learner.address={address}", "hydra.run.dir=run")
    done = in_process("finetune", f"run={trained}", *words, folder=tmp_path)
    assert done.code == 1
    assert f"learner.address={address} does not answer (Connection refused); start Ray on its" in done.err
    assert not (tmp_path / "run/recordings").exists()


PUSH = """
import sys
from pathlib import Path
import ray
from cartpole_rl.evaluation.recordings import read_recording
from cartpole_rl.workflows.ray_learner import Taken
from cartpole_rl.workflows.ray_learner import joined

address, name, recording = sys.argv[1:]
with joined(address):
    learner = ray.get_actor(name)
    taken, _, arrived = ray.get(learner.exchange.remote(Taken(), 0, []))
    episodes = [read_recording(Path(recording)).episode] * (3 - arrived)
    assert ray.get(learner.exchange.remote(taken, arrived, episodes))[2] == 3
"""


@pytest.mark.nightly
def test_a_learner_with_an_episode_that_was_moved_away_is_replaced(
    trained: Path, tuned: tuple[Path, Outcome], head: tuple[str, "subprocess.Popen[bytes]"], tmp_path: Path
) -> None:
    """A session was interrupted after its first episode to learn from, and its learner has one more."""
    run, alone = tmp_path / "run", tuned[0]
    words = (*FINETUNING, "learner=ray", f"learner.address={head[0]}", "hydra.run.dir=run")
    interrupt_after(run / "recordings/tune_000.csv")
    assert in_process("finetune", f"run={trained}", *words, folder=tmp_path).code == 130
    name = load_training(run, FINETUNING_FORMAT).state[NAME]
    push = [sys.executable, "-c", PUSH, head[0], name, str(run / "recordings/tune_000.csv")]
    subprocess.run(push, check=True, env={**os.environ, **SETTINGS})
    done = in_process("finetune", "resume=run", folder=tmp_path)
    assert done.code == 0, done.err
    assert "a recording was moved away since: a new learner starts" in done.err
    expected, found = (sorted(path.name for path in each.glob("recordings/*")) for each in (alone, run))
    assert found == expected
