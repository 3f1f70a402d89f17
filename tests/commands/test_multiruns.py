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
from hydra_configs import shipped_choices
from omegaconf import DictConfig

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
    with shipped_choices():
        yield


def folder_of_a_job(multirun: DictConfig, word: str) -> str:
    """Compose a job as Hydra's launchers do, in this process or another."""
    loader = GlobalHydra.instance().config_loader()
    return loader.load_sweep_config(multirun, [word]).hydra.sweep.dir


def folder_in_another_process(multirun: DictConfig, word: str, cwd: str) -> str:
    with contextlib.chdir(cwd), shipped_choices():
        return folder_of_a_job(multirun, word)


def test_two_multiruns_of_the_same_second(tmp_path: Path, same_second: None) -> None:
    for start in ("hanging", "upright"):
        words = (
            "run=lqr",
            "episodes=1",
            "seed=0,1",
            "task=swingup",
            "task.time_limit=10",
            f"task.evaluation_start.angle={start}",
        )
        done = in_process("record", "-m", *words, folder=tmp_path)
        assert done.code == 0, done.err
    jobs = {
        multirun.name: sorted(job.name for job in multirun.iterdir() if job.is_dir())
        for multirun in tmp_path.glob("runs/record/*")
    }
    day = "2026-11-21_12-00-00_multirun"
    assert jobs == {day: ["0_seed-0", "1_seed-1"], f"{day}_2": ["0_seed-0", "1_seed-1"]}
    assert len(list(tmp_path.glob("runs/record/*/*/recordings/episode_000.csv"))) == 4


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_gives_each_multirun_its_own(
    command: str, composing_here: None, same_second: None
) -> None:
    given = {"evaluate": ["run=any"], "record": ["run=any"], "replay": ["from=any"], "model": ["from=any"]}
    multiruns = [hydra.compose(command, given.get(command, []), return_hydra_config=True) for _ in range(2)]
    folders = [multirun.hydra.sweep.dir for multirun in multiruns]
    assert len(set(folders)) == 2
    assert all(
        Path(folder).is_dir() and Path(folder).parent == Path.cwd() / "runs" / command for folder in folders
    )
    for multirun, folder in zip(multiruns, folders, strict=True):
        assert folder_of_a_job(multirun, "label=first") == folder
    assert len(list(Path("runs", command).iterdir())) == 2


def test_jobs_in_other_processes_share_the_folder(tmp_path: Path, composing_here: None) -> None:
    multirun = hydra.compose("train", return_hydra_config=True)
    folder = multirun.hydra.sweep.dir  # Hydra makes it before it launches the jobs
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        jobs = [
            pool.submit(folder_in_another_process, multirun, f"seed={seed}", str(tmp_path)) for seed in (1, 2)
        ]
        assert [job.result() for job in jobs] == [folder, folder]
    assert [path.name for path in (tmp_path / "runs/train").iterdir()] == [Path(folder).name]
