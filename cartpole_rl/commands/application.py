"""What makes a function of a config into a command: Hydra in front, one line for each error, an exit code."""

import difflib
import logging
import os
import re
import signal
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar

import hydra
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cartpole_rl.commands.config import checked
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.settings import Settings

INTERRUPTED = 130  # what a shell reports for Ctrl-C
Config = TypeVar("Config", bound=Settings)
LARGE_POLE = {"pole_mass": 0.233, "pole_com": 0.328, "pole_inertia": 8.0e-3}


def conf_folder() -> Path:
    """The shipped conf/: inside the package when it was installed as a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def run_folder(command: str, label: str, resume: str | None) -> str:
    """Folder of a run: that of the training which is resumed, or a new one by date and time."""
    if resume not in (None, "", "None", "null"):
        return str(resume)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return f"runs/{command}/{stamp}" + (f"_{label}" if label not in ("", "''") else "")


OmegaConf.register_new_resolver("run_folder", run_folder, use_cache=True)
for _pole, _truth in (("medium", EmulatorSettings()), ("large", EmulatorSettings(**LARGE_POLE))):
    ConfigStore.instance().store(group="emulator", name=_pole, node=_truth.model_dump(mode="json"))


def application(name: str, schema: type[Config]) -> Callable[[Callable[[Config, Path], None]], Callable[[], None]]:
    """Decorator: the command `cartpole-<name>`, whose config conf/<name>.yaml is checked against `schema`.

    The function gets the checked config and the run folder, which exists. Errors of this package, of Hydra, and
    of the config are printed as one line; their exit codes are 1 (the work failed) and 2 (the config is wrong).
    """

    def decorate(body: Callable[[Config, Path], None]) -> Callable[[], None]:
        def task(composed: DictConfig) -> None:
            try:
                values = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
                config = checked(schema, values)  # type: ignore[arg-type]
                body(config, Path(hydra.core.hydra_config.HydraConfig.get().runtime.output_dir))
            except CartPoleError as error:
                leave(name, str(error), error.exit_code)
            except OmegaConfBaseException as error:
                leave(name, first_line(error), ConfigError.exit_code)
            except KeyboardInterrupt:
                leave(name, "interrupted", INTERRUPTED)

        def main() -> None:
            signal.signal(signal.SIGTERM, _terminate)
            logging.getLogger("torchrl").setLevel(logging.WARNING)
            os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # so that Hydra's errors come here, not to the screen
            try:
                hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name=name)(task)()
            except HydraException as error:
                leave(name, explain(error, name), ConfigError.exit_code)
            except OmegaConfBaseException as error:
                leave(name, first_line(error), ConfigError.exit_code)

        return main

    return decorate


def leave(name: str, message: str, code: int) -> NoReturn:
    """Print one line and exit."""
    print(f"cartpole-{name}: {message}", file=sys.stderr)
    raise SystemExit(code)


def first_line(error: BaseException) -> str:
    """What an error of OmegaConf says before it comes to its own workings."""
    lines = str(error).splitlines() or [type(error).__name__]
    missing = re.match(r"Missing mandatory value: (\S+)", lines[0])
    return f"{missing[1]} is missing; give {missing[1]}=..." if missing else lines[0]


def explain(error: HydraException, name: str) -> str:
    """An error of Hydra in one line; for an unknown key with the nearest one that exists."""
    text = " ".join(str(error).split())
    unknown = re.match(r"Could not override '([^']+)'", text)
    if unknown and "find the group" not in text:
        return unknown_key(unknown[1], name)
    choice = re.match(r"(?:In '[^']*': )?Could not find '([^']+)'.*?Available options in '[^']+':(.*?)(?:Config search|$)", text)
    if choice:
        group, _, wrong = choice[1].rpartition("/")
        return f"{group}={wrong}: there is no such choice; there are {', '.join(choice[2].split())}"
    return text.split(" Set the environment variable")[0]


def unknown_key(key: str, name: str) -> str:
    """Say that `key` is no setting of the command, and which one is nearest."""
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
        known = sorted(_keys(OmegaConf.to_container(hydra.compose(config_name=name), resolve=False)))
    nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    hint = f"; did you mean {nearest[0]}?" if nearest else "; --cfg job shows the settings"
    return f"{key}: there is no such setting{hint}"


def _keys(tree: Any, prefix: str = "") -> set[str]:
    if not isinstance(tree, dict):
        return {prefix}
    below = {key for name, value in tree.items() for key in _keys(value, f"{prefix}.{name}" if prefix else name)}
    return below | ({prefix} if prefix else set())


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    """SIGTERM unwinds like an exception, so that every `with` stops its motor."""
    raise SystemExit(128 + number)
