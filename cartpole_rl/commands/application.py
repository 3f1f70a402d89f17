"""What makes a function of a config into a command: Hydra in front, one line for each error, an exit code.

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
from cartpole_rl.workflows.person import tell

INTERRUPTED, SIGNALLED = 130, 128  # what a shell reports: for SIGINT, and plus its number for another signal
Config = TypeVar("Config", bound=Settings)
Body = Callable[[Config, Path], None]
EXPECTED = (CartPoleError, HydraException, OmegaConfBaseException, OSError)  # told in a line, without a trace


class Terminated(BaseException):
    """SIGTERM or SIGHUP came. It unwinds like an exception, so that every `with` stops its motor."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def application(name: str, schema: type[Config]) -> Callable[[Body[Config]], Callable[[], None]]:
    """Decorator: the command `cartpole-<name>`, whose config conf/<name>.yaml is checked against `schema`.

    The function gets the checked config and the run folder, which exists; it is taken away again if nothing
    was written into it. In a multirun a job that fails does not keep the others from running.
    """

    def decorate(body: Body[Config]) -> Callable[[], None]:
        given: list[str] = []

        def task(composed: DictConfig) -> None:
            sys.argv[1:] = given  # what was typed is what the run's folder keeps
            quieten()  # here, since a launcher may have brought the job to another process
            folder = Path(HydraConfig.get().runtime.output_dir)
            try:
                body(checked(schema, as_mapping(composed)), folder)
            except EXPECTED as error:
                if HydraConfig.get().mode is RunMode.MULTIRUN:
                    tell(name, in_one_line(error, name))
                    raise  # Hydra keeps it until all jobs are through
                exit_with_message(name, error)
            finally:
                remove_if_empty(folder)

        def main() -> None:
            given[:] = sys.argv[1:]
            handler = RaiseOnce(_ended)
            handler.handle(*ending_signals())
            if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
                handler.handle(signal.SIGINT)
            OmegaConf.register_new_resolver("choices_of", partial(choices_of, name, schema), replace=True)
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # Hydra's errors come here, not to the screen
            try:
                if dashed := dashed_setting(sys.argv[1:]):
                    raise ConfigError(f"{dashed}: settings are given without dashes: {dashed.lstrip('-')}")
                with with_choice_files(given) as words:
                    sys.argv[1:] = words
                    hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=name)(task)()
            except EXPECTED as error:
                exit_with_message(name, error)
            except KeyboardInterrupt:
                tell(name, "interrupted")
                sys.exit(INTERRUPTED)
            except Terminated as ended:
                tell(name, "terminated")
                sys.exit(SIGNALLED + ended.number)

        return main

    return decorate


def exit_with_message(name: str, error: Exception) -> NoReturn:
    """Tell an error and exit. Raises one that names nothing a user could look at."""
    code = CartPoleError.exit_code
    if isinstance(error, CartPoleError):
        code = error.exit_code
    elif isinstance(error, HydraException | OmegaConfBaseException):  # some of which are OSErrors too
        code = ConfigError.exit_code
    elif isinstance(error, OSError) and not error.filename:
        raise error
    tell(name, in_one_line(error, name))
    sys.exit(code)


def quieten() -> None:
    """Silence what libraries say of themselves and no user can do anything about."""
    os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reads it when it is imported
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # where it is imported already
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)  # CUDA's compiler without a GPU
    # tensordict 0.14 asks torch 2.15 for a setting that is on its way out
    warnings.filterwarnings("ignore", r"torch\._dynamo\.config\.inline_inbuilt_nn_modules", FutureWarning)


def remove_if_empty(folder: Path) -> None:
    """Take away a run folder that a run left as it found it."""
    if folder != Path.cwd():
        with suppress(OSError):  # it is not empty
            folder.rmdir()


def _ended(number: int) -> BaseException:
    """What a signal raises."""
    return KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
