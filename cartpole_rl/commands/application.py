"""Makes a command of a function: Hydra composes its config, and each error is one line and an exit code.

Exit codes: 0; 1 where the work failed; 2 where the config is wrong; 130 after Ctrl-C; 143 after SIGTERM; 129
after SIGHUP, which a closed terminal or a dropped ssh connection sends.
"""

import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NoReturn, TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cartpole_rl.checking import checked
from cartpole_rl.choices import conf_folder
from cartpole_rl.commands.choice_files import with_choice_files
from cartpole_rl.commands.complaints import dashed_setting, in_one_line
from cartpole_rl.commands.composition import as_mapping, choices_of
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.settings import Settings
from cartpole_rl.signals import RaiseOnce, ending_signals
from cartpole_rl.workflows.person import print_message

INTERRUPTED, SIGNALLED = 130, 128  # what a shell reports: for SIGINT, and plus its number for another signal
Config = TypeVar("Config", bound=Settings)
Body = Callable[[Config, Path], None]
EXPECTED = (CartPoleError, HydraException, OmegaConfBaseException, OSError)  # printed without a traceback


class Terminated(BaseException):
    """SIGTERM or SIGHUP arrived. It unwinds like an exception, so every `with` stops its motor."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def application(name: str, schema: type[Config]) -> Callable[[Body[Config]], Callable[[], None]]:
    """Return a decorator that makes the command cartpole-<name>, with conf/<name>.yaml checked by `schema`.

    The function gets the checked config and the run folder, which is removed at the end if it is empty. In a
    multirun the other jobs run even if one fails.
    """

    def decorate(body: Body[Config]) -> Callable[[], None]:
        given: list[str] = []

        def task(composed: DictConfig) -> None:
            sys.argv[1:] = given  # as typed, for provenance.json
            quieten()  # here, since a launcher may run the job in another process
            folder = Path(HydraConfig.get().runtime.output_dir)
            try:
                body(checked(schema, as_mapping(composed)), folder)
            except EXPECTED as error:
                if HydraConfig.get().mode is RunMode.MULTIRUN:
                    print_message(name, in_one_line(error, name))
                    raise  # Hydra keeps it until all jobs have ended
                exit_with_message(name, error)
            finally:
                remove_if_empty(folder)

        def main() -> None:
            given[:] = sys.argv[1:]
            catch_signals()
            OmegaConf.register_new_resolver("choices_of", partial(choices_of, name, schema), replace=True)
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra raises its errors instead of printing them
            try:
                if dashed := dashed_setting(sys.argv[1:]):
                    raise ConfigError(f"{dashed}: settings are given without dashes: {dashed.lstrip('-')}")
                with with_choice_files(given) as words:
                    sys.argv[1:] = words
                    hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=name)(task)()
            except EXPECTED as error:
                exit_with_message(name, error)
            except KeyboardInterrupt:
                print_message(name, "interrupted")
                sys.exit(INTERRUPTED)
            except Terminated as ended:
                print_message(name, "terminated")
                sys.exit(SIGNALLED + ended.number)

        return main

    return decorate


def exit_with_message(name: str, error: Exception) -> NoReturn:
    """Print an error and exit. Raises an OSError that names no file: it is a defect of this package."""
    code = CartPoleError.exit_code
    if isinstance(error, CartPoleError):
        code = error.exit_code
    elif isinstance(error, HydraException | OmegaConfBaseException):  # some of which are OSErrors too
        code = ConfigError.exit_code
    elif isinstance(error, OSError) and not error.filename:
        raise error
    print_message(name, in_one_line(error, name))
    sys.exit(code)


def quieten() -> None:
    """Silence messages of libraries that a user can do nothing about."""
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # read when TorchRL is imported
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # if it is imported already
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)  # no CUDA compiler
    # tensordict 0.14 reads a setting that torch 2.15 deprecates
    warnings.filterwarnings("ignore", r"torch\._dynamo\.config\.inline_inbuilt_nn_modules", FutureWarning)


def remove_if_empty(folder: Path) -> None:
    """Remove a run folder if nothing was written to it."""
    if folder != Path.cwd():
        with suppress(OSError):  # it is not empty
            folder.rmdir()


def catch_signals() -> None:
    """Make SIGTERM, SIGHUP and SIGINT raise, except for those that the parent process ignores."""
    handler = RaiseOnce(_exception_of)
    handler.handle(*ending_signals())
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        handler.handle(signal.SIGINT)


def _exception_of(number: int) -> BaseException:
    """Return the exception that a signal raises."""
    return KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
