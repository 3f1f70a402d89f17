"""Makes a command of a function: Hydra composes its config, and each error is one line and an exit code."""

import logging
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from cartpole_rl import __version__
from cartpole_rl.checking import checked
from cartpole_rl.choices import conf_folder
from cartpole_rl.commands.hydra_application.choice_files import with_choice_files
from cartpole_rl.commands.hydra_application.complaints import dashed_setting, wrong_option
from cartpole_rl.commands.hydra_application.composition import as_mapping, choices_of
from cartpole_rl.commands.hydra_application.exits import (
    EXPECTED,
    Terminated,
    catch_signals,
    exit_after_signal,
    exit_with_message,
    job_signals,
)
from cartpole_rl.commands.hydra_application.sweeps import as_multirun, is_job, run_as_job, shown_jobs, sweep
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings

Config = TypeVar("Config", bound=Settings)
Body = Callable[[Config, Path], float | None]


def application(name: str, schema: type[Config]) -> Callable[[Body[Config]], Callable[[], None]]:
    """Return a decorator that makes the command cartpole-<name>, with conf/<name>.yaml checked by `schema`.

    The function gets the checked config and the run folder, which is removed at the end if it is empty. It
    may return a score, which a sweep by Optuna maximizes.
    """

    def decorate(body: Body[Config]) -> Callable[[], None]:
        given: list[str] = []

        def task(composed: DictConfig) -> float | None:
            sys.argv[1:] = given  # as typed, for provenance.json
            quieten()  # here, since a launcher may run the job in another process
            folder = Path(HydraConfig.get().runtime.output_dir)

            def work() -> float | None:
                return body(checked(schema, as_mapping(composed)), folder)

            with job_signals():
                try:
                    return run_as_job(name, folder, work) if is_job() else work()
                except EXPECTED as error:
                    exit_with_message(name, error)
                finally:
                    remove_if_empty(folder, name)

        def main() -> None:
            given[:] = sys.argv[1:]
            accept_all_characters()
            catch_signals()
            OmegaConf.register_new_resolver("choices_of", partial(choices_of, name, schema), replace=True)
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises its errors instead of printing them
            try:
                if "--version" in given:
                    print(f"cartpole_rl {__version__}")
                    return
                if wrong := wrong_option(given) or dashed_setting(given):
                    raise ConfigError(wrong)
                with with_choice_files(as_multirun(given)) as words, sweep(name, schema):
                    for job in shown_jobs(words) or [words]:
                        sys.argv[1:] = job
                        hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=name)(
                            task
                        )()
            except EXPECTED as error:
                exit_with_message(name, error)
            except (KeyboardInterrupt, Terminated) as signalled:
                exit_after_signal(name, signalled)

        return main

    return decorate


def accept_all_characters() -> None:
    """Let the output replace characters that its encoding lacks, as that of a pipe on Windows does."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def quieten() -> None:
    """Silence messages of libraries that a user can do nothing about."""
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # read when TorchRL is imported
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # if it is imported already
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)  # no CUDA compiler
    # tensordict 0.14 reads a setting that torch 2.15 deprecates
    warnings.filterwarnings("ignore", r"torch\._dynamo\.config\.inline_inbuilt_nn_modules", FutureWarning)


def remove_if_empty(folder: Path, name: str) -> None:
    """Remove a run folder if nothing was written to it, then runs/<name>/ and runs/ if they are empty."""
    if folder == Path.cwd():
        return
    runs = Path.cwd() / "runs"
    above = (runs / name, runs) if folder.parent == runs / name else ()
    with suppress(OSError):  # one is not empty
        for each in (folder, *above):
            each.rmdir()
