"""The folder of a multirun: one for all of its jobs, in whichever process they run, and for no other one."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from datetime import datetime
from multiprocessing import get_context
from pathlib import Path

import hydra
import pytest
from command_line import in_process
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig

from cartpole_rl.composition import reading_conf

COMMANDS = ("evaluate", "finetune", "identify", "model", "record", "replay", "report", "train")


class StoppedClock(datetime):
    """A clock by which all multiruns start in the same second."""

    @classmethod
    def now(cls, tz=None) -> datetime:
        return datetime(2026, 11, 21, 12, 0, 0)


@pytest.fixture
def same_second(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("cartpole_rl.sweeps", "hydra.core.utils"):
        monkeypatch.setattr(f"{module}.datetime", StoppedClock)


@pytest.fixture
def composing_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    with reading_conf():
        yield


def folder_of_a_job(multirun: DictConfig, word: str) -> str:
    """Compose a job as Hydra's launchers do, in this process or another."""
    loader = GlobalHydra.instance().config_loader()
    return loader.load_sweep_config(multirun, [word]).hydra.sweep.dir


def folder_in_another_process(multirun: DictConfig, word: str, cwd: str) -> str:
    with contextlib.chdir(cwd), reading_conf():
        return folder_of_a_job(multirun, word)


def test_two_multiruns_of_the_same_second(tmp_path: Path, same_second: None) -> None:
    for _ in range(2):
        words = ("-m", "run=lqr", "seed=0,1")
        done = in_process("record", *words, folder=tmp_path, function=lambda folder: (folder / "run").touch())
        assert done.code == 0, done.err
    found = {path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("runs/record/*/*/*")}
    multiruns = (f"runs/record/2026-11-21_12-00-00_multirun{suffix}" for suffix in ("", "_2"))
    assert found == {f"{multirun}/{seed}_seed-{seed}/run" for multirun in multiruns for seed in (0, 1)}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_gives_all_jobs_a_new_folder(
    command: str, composing_here: None, same_second: None
) -> None:
    earlier = Path("runs", command, "2026-11-21_12-00-00_multirun")
    earlier.mkdir(parents=True)
    multirun = hydra.compose(command, return_hydra_config=True)
    new = Path.cwd() / f"{earlier}_2"
    assert multirun.hydra.sweep.dir == folder_of_a_job(multirun, "label=first") == str(new)
    assert {*Path("runs", command).iterdir()} == {earlier, new.relative_to(Path.cwd())}


def test_jobs_in_other_processes_share_the_folder(tmp_path: Path, composing_here: None) -> None:
    multirun = hydra.compose("train", return_hydra_config=True)
    folder = multirun.hydra.sweep.dir  # Hydra makes it before it launches the jobs
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        jobs = [
            pool.submit(folder_in_another_process, multirun, f"seed={seed}", str(tmp_path)) for seed in (1, 2)
        ]
        assert [job.result() for job in jobs] == [folder, folder]
    assert [path.name for path in (tmp_path / "runs/train").iterdir()] == [Path(folder).name]
