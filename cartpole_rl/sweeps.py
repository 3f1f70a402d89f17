"""Folders of runs and of the jobs of sweeps, and what becomes of jobs that fail.

A sweep ends before it starts if a setting of any job has a wrong name, type or range, or for a training that
`TrainConfig.check_learning` refuses. Other checks, as of files and carts, are those of the job: a
failed job does not end a sweep. The end of a sweep names every failed job with the reason. Each job keeps
error.txt in its run folder until it succeeds. So the report is the same with every launcher, and it includes
jobs that were killed.
"""

import logging
import os
import re
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict, read_write

from cartpole_rl.checking import kinds, validated
from cartpole_rl.composition import (
    MULTIRUN_FLAGS,
    as_mapping,
    is_completing,
    own_folder,
    reading_conf,
    task_overrides,
)
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.exits import OF_HYDRA, exit_with_message, is_defect, one_line, signal_behind
from cartpole_rl.files import write_text
from cartpole_rl.run_folder import CONFIG, ERROR, MULTIRUN
from cartpole_rl.settings import Settings
from cartpole_rl.terminal import as_word, print_message, program

MODES = MULTIRUN_FLAGS | {"-r", "--run", "-i", "--info", "-sc", "--shell-completion"}
REPORTED = ("train", "finetune", "evaluate")  # commands whose runs cartpole-report compares
NOT_ENDED = "it was killed or interrupted, or is still running"

SQLITE = "sqlite:///"  # before the path of a study of Optuna's
LONGEST_NAME = 150  # bytes; file systems take 255


def run_folder(command: str, label: Any, resume: Any = None) -> str:
    """Return the folder of a run: that of the resumed run, or a new one named by date and time.

    A new one is made here, so runs that start in the same second do not share it. Nothing is checked yet.
    """
    if isinstance(resume, str) and Path(resume).is_dir():
        return resume
    return new_folder(command, label)


def sweep_folder(command: str) -> str:
    """Return the folder of a multirun: a new one named by date and time, made here as that of a run.

    Hydra composes the config of each job anew with the cached values of its resolvers, in other processes
    too, so all jobs of a multirun share the folder. The path is absolute, since such a process may have
    another working directory.
    """
    return str(Path(new_folder(command, "multirun")).absolute())


def new_folder(command: str, label: str) -> str:
    """Make a new folder named by date, time and `label`, and return its path."""
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + (f"_{label}" if label else "").replace("/", "-")
    for number in count(1):
        folder = Path("runs", command, name if number == 1 else f"{name}_{number}")
        with suppress(FileExistsError):
            try:
                folder.mkdir(parents=True)
            except FileNotFoundError:  # a command that failed has just removed the empty parent
                folder.mkdir(parents=True)
            break
    return str(folder)


def constant_settings() -> list[str]:
    """Return the settings on the command line that are the same in all jobs of a multirun."""
    words = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(words)
    return [each.get_key_element() for each in parsed if not each.is_sweep_override()]


def job_name(number: int, overrides: list[str] | ListConfig, constant: Collection[str]) -> str:
    """Return the folder of one job of a multirun, by its swept settings: "0_randomization-friction_3_seed-0".

    Characters that a shell or Hydra would interpret become "-".
    """
    given = (word for word in task_overrides(overrides) if "=" in word and not is_completing(word))
    swept = (word for word in given if word.split("=")[0] not in constant)
    plain = (re.sub(r"[^\w.+-]+", "-", word).strip("-") for word in swept)
    return "_".join((str(number), *plain)).encode()[:LONGEST_NAME].decode(errors="ignore")


OmegaConf.register_new_resolver("run_folder", run_folder, use_cache=True)
OmegaConf.register_new_resolver("sweep_folder", sweep_folder, use_cache=True)
OmegaConf.register_new_resolver("constant_settings", constant_settings, use_cache=True, replace=True)
OmegaConf.register_new_resolver("job_name", job_name)


class SweepStart(Callback):
    """Hydra's callback that checks all jobs, notes the folder of the sweep and what jobs cannot know."""

    command: ClassVar[str] = ""
    schema: ClassVar[type[Settings]] = Settings
    folder: ClassVar[Path | None] = None

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Check the jobs; resolve folder and constant settings here: Hydra hands the values to the jobs.

        It exits for a wrong setting, since Hydra swallows what a callback raises.
        """
        try:
            check_jobs(config, SweepStart.schema)
            SweepStart.folder = folder = Path(config.hydra.sweep.dir)
            _ = config.hydra.job.config.override_dirname.exclude_keys
            check_folder(config, folder)
            folder.mkdir(parents=True, exist_ok=True)
            if not (folder / MULTIRUN).exists():  # not every sweeper of Hydra writes it
                OmegaConf.save(config, folder / MULTIRUN)
            storage = OmegaConf.select(config, "hydra.sweeper.storage")
            if isinstance(storage, str) and storage.startswith(SQLITE):
                Path(storage.removeprefix(SQLITE)).parent.mkdir(parents=True, exist_ok=True)
        except (ConfigError, OSError, *OF_HYDRA) as error:
            exit_with_message(SweepStart.command, error, kinds(SweepStart.schema, "plant"))


def check_folder(config: DictConfig, folder: Path) -> None:
    """Raise ConfigError if a job of a sweep would write into a run that is in the sweep's `folder`."""
    if not any(folder.rglob(CONFIG)):
        return
    for number, job in enumerate(jobs_of(config)):
        composed = GlobalHydra.instance().config_loader().load_sweep_config(config, job)
        with read_write(composed), open_dict(composed):
            composed.hydra.job.num, composed.hydra.job.id = number, str(number)
        run = folder / composed.hydra.sweep.subdir
        if (run / CONFIG).exists():
            raise ConfigError(f"{run}: it holds a run already; give another hydra.sweep.dir")


def check_jobs(config: DictConfig, schema: type[Settings]) -> None:
    """Raise for the first job of a sweep with a wrong setting, unless its sweeper chooses while it runs.

    What a job reads or compiles is checked where it runs.
    """
    from cartpole_rl.workflows.config import TrainConfig  # a command without a sweep may need none of it

    for word in OmegaConf.select(config, "hydra.overrides.hydra") or ():
        if word.startswith("hydra.run.dir="):
            raise ConfigError(f"{word} is the folder of one run; give that of a sweep as hydra.sweep.dir=")
    for job in jobs_of(config):
        composed = GlobalHydra.instance().config_loader().load_sweep_config(config, job)
        with read_write(composed), open_dict(composed):
            del composed["hydra"]
        if composed.get("resume") is not None:
            raise ConfigError(
                f"resume= continues one run; call {program(SweepStart.command)} once for each, without -m"
            )
        checked = validated(schema, as_mapping(composed))
        if isinstance(checked, TrainConfig):
            checked.check_learning()


def jobs_of(config: DictConfig) -> list[list[str]]:
    """Return the overrides of each job of a sweep; none if its sweeper chooses them while it runs."""
    sweeper = config.hydra.sweeper
    if not sweeper._target_.endswith(BasicSweeper.__name__):
        return []
    words = [f"{key}={value}" for key, value in (sweeper.params or {}).items()]
    words += task_overrides(config.hydra.overrides.task)
    overrides = OverridesParser.create(GlobalHydra.instance().config_loader()).parse_overrides(words)
    (jobs,) = BasicSweeper.split_arguments(overrides, None)
    return jobs


def as_multirun(words: Sequence[str]) -> list[str]:
    """Return the words of a command line, with -m beside sweep=...: a choice cannot set the mode.

    Hydra takes one mode, so the others stay alone; `shown_jobs` shows the settings of each job.
    """
    chosen = any(word.startswith("sweep=") for word in words)
    has_mode = any(word.partition("=")[0] in MODES for word in words) or {"hydra", "all"} & {*words}
    return [*words, "--multirun"] if chosen and not has_mode else [*words]


def shown_jobs(command: str, words: Sequence[str]) -> list[list[str]]:
    """Return the command lines that show the settings of each job: those of `-m --cfg job`; else none."""
    if MULTIRUN_FLAGS.isdisjoint(words) or {"-c", "--cfg"}.isdisjoint(words):
        return []
    overrides = [word for word in words if "=" in word and not word.startswith("-")]
    if folder := own_folder(words):
        overrides.append(f"hydra.searchpath=[file://{folder}]")
    with reading_conf():
        loader = GlobalHydra.instance().config_loader()
        config = loader.load_configuration(command, overrides, RunMode.MULTIRUN)
        task = task_overrides(config.hydra.overrides.task)
        jobs = jobs_of(config) or [task]
    others = [word for word in words if word not in {*task, *MULTIRUN_FLAGS}]
    return [[*job, *others] for job in jobs]


def is_job() -> bool:
    """Return True in a job of a sweep."""
    return HydraConfig.get().mode is RunMode.MULTIRUN


def run_as_job(name: str, folder: Path, work: Callable[[], float | None]) -> float | None:
    """Return the result of a job of a sweep; None if it failed, with the reason printed and in error.txt."""
    if not HydraConfig.get().job.chdir:
        os.chdir(HydraConfig.get().runtime.cwd)  # on a cluster, a worker may start in another folder
    write_text(folder / ERROR, f"{NOT_ENDED}\n")
    print_message(name, f"job {folder.name}")
    try:
        result = work()
    except Exception as error:
        if (signalled := signal_behind(error)) is not None:
            raise signalled from None
        print_message(name, reason := one_line(error, name))
        details = traceback.format_exc() if is_defect(error) else ""
        write_text(folder / ERROR, f"{reason}\n{details}")
        return None
    (folder / ERROR).unlink(missing_ok=True)
    return result


@contextmanager
def sweep(name: str, schema: type[Settings]) -> Iterator[None]:
    """Check the jobs of a sweep by `schema`; at its end, name the failed ones and exit with 1 for any.

    Without one, print the command that compares them.
    The launcher itself fails if the process of a job is killed. What it raises is named too.
    """
    logging.getLogger("hydra_plugins").setLevel(logging.ERROR)  # failed jobs are named here
    SweepStart.command, SweepStart.schema, SweepStart.folder = name, schema, None
    try:
        yield
    except Exception as error:
        if not _jobs():
            raise
        print_message(name, f"the sweep was stopped: {one_line(error, name)}")
        _report(name)
        sys.exit(CartPoleError.exit_code)
    if _report(name):
        sys.exit(CartPoleError.exit_code)
    if (jobs := _jobs()) and name in REPORTED:
        folder = os.path.relpath(jobs[0].parent)
        print(f"{folder}/ holds {len(jobs)} runs; next:")
        print(f"{program('report')} {as_word('runs', folder)}")


def _report(name: str) -> int:
    """Print the failed jobs of the sweep, and return their number."""
    jobs = _jobs()
    failed = [job for job in jobs if (job / ERROR).exists()]
    if failed:
        print_message(name, f"{len(failed)} of {len(jobs)} jobs failed in {os.path.relpath(jobs[0].parent)}:")
    for job in failed:
        print_message(name, f"{job.name}: {(job / ERROR).read_text('utf-8').splitlines()[0]}")
    return len(failed)


def _jobs() -> list[Path]:
    """Return the run folders of the sweep, in the order of their numbers; none outside of a sweep."""
    if SweepStart.folder is None or not SweepStart.folder.is_dir():
        return []
    jobs = (path for path in SweepStart.folder.iterdir() if path.is_dir() and path.name[0] != ".")
    return sorted(jobs, key=lambda job: [int(number) for number in re.findall(r"^\d+", job.name)])
