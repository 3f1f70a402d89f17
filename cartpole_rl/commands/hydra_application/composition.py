"""Extends Hydra: names of run folders, the choices in --help, the defaults of the emulated cart."""

import re
import shutil
import sys
import textwrap
import warnings
from collections.abc import Collection, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import MISSING, DictConfig, OmegaConf

from cartpole_rl.checking import kinds
from cartpole_rl.choices import default_choices, without_missing
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.settings import Settings
from cartpole_rl.workflows.config import EvaluateConfig

LONGEST_NAME = 150  # characters; file systems take 255


def run_folder(command: str, label: str, resume: str | None = None) -> str:
    """Return the folder of a run: that of the resumed run, or a new one named by date and time.

    A new one is made here, so runs that start in the same second do not share it.
    """
    if resume is not None and Path(resume).is_dir():
        return str(resume)
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
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + (f"_{label}" if label else "")
    for number in count(1):
        folder = Path("runs", command, name if number == 1 else f"{name}_{number}")
        with suppress(FileExistsError):
            _make(folder)
            break
    return str(folder)


def _make(folder: Path) -> None:
    """Make `folder`. Raises FileExistsError if it exists."""
    try:
        folder.mkdir(parents=True)
    except FileNotFoundError:  # a command that failed has just removed the empty parent
        folder.mkdir(parents=True)


def constant_settings() -> list[str]:
    """Return the settings on the command line that are the same in all jobs of a multirun."""
    words = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(words)
    return [each.get_key_element() for each in parsed if not each.is_sweep_override()]


def job_name(number: int, overrides: Sequence[str], constant: Collection[str]) -> str:
    """Return the folder of one job of a multirun, by its swept settings: "0_randomization-friction_3_seed-0".

    Characters that a shell or Hydra would interpret become "-".
    """
    swept = (word for word in overrides if "=" in word and word.split("=")[0] not in constant)
    plain = (re.sub(r"[^\w.+-]+", "-", word).strip("-") for word in swept)
    return "_".join((str(number), *plain))[:LONGEST_NAME]


def choices_of(command: str, schema: type[Settings]) -> str:
    """Return the groups that cartpole-<command> reads, for its --help: a line each, with all choices.

    Choices in folders of a user's own are listed too; plants that `schema` does not take are not.
    """
    loader = GlobalHydra.instance().config_loader()
    refused = {"plant": {*kinds(EvaluateConfig, "plant")} - {*kinds(schema, "plant")}}
    lines = [
        f"  {group}: {', '.join(sorted({*loader.get_group_options(group)} - refused.get(group, set())))}"
        for group in sorted(default_choices(command))
    ]
    return "\n".join(("Choices (group=choice)", *map(wrapped, lines), "\n")) if lines else ""


def wrapped(line: str) -> str:
    """Return a line of choices, wrapped where standard output is a narrow terminal."""
    if not sys.stdout.isatty():
        return line
    width = max(40, shutil.get_terminal_size().columns - 1)
    return textwrap.fill(line, width, subsequent_indent="    ", break_on_hyphens=False)


def as_mapping(composed: DictConfig) -> dict[str, Any]:
    """Return the composed config, resolved, as plain mappings without the missing values (`???`)."""
    return without_missing(OmegaConf.to_container(composed, resolve=True))


DEPRECATED_IN_1_4 = (  # and needed in Hydra 1.3
    r"register_new_resolver\(\) is deprecated",
    "The version_base parameter is deprecated",
    r"hydra\.utils\.instantiate\(\) resolved _target_=",
)
warnings.filterwarnings("ignore", "|".join(DEPRECATED_IN_1_4))
OmegaConf.register_new_resolver("run_folder", run_folder, use_cache=True)
OmegaConf.register_new_resolver("sweep_folder", sweep_folder, use_cache=True)
OmegaConf.register_new_resolver("constant_settings", constant_settings, use_cache=True)
OmegaConf.register_new_resolver("job_name", job_name)
# conf/emulator/ extends this choice; its numbers are the defaults of the settings class
ConfigStore.instance().store(group="emulator", name="medium", node=EmulatorSettings().model_dump(mode="json"))
# so does conf/plant/serial.yaml
ConfigStore.instance().store(name="serial_defaults", node=SerialSettings(port=MISSING).model_dump())
