"""What Hydra has to know before it composes: how folders are named, the emulated cart."""

import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from itertools import count
from pathlib import Path

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from cartpole_rl.emulator.settings import EmulatorSettings

LONGEST_NAME = 150  # characters; file systems take 255


def run_folder(command: str, label: str, resume: str | None = None) -> str:
    """Folder of a run: that of the training which is resumed, or a new one by date and time.

    A new one is made here, so that runs which start in the same second do not share it.
    """
    if resume is not None and Path(resume).is_dir():
        return str(resume)
    return new_folder(command, label)


def sweep_folder(command: str) -> str:
    """Folder of a multirun: a new one by date and time, made here for the same reason as that of a run.

    Hydra composes the config of each job anew, and gives it the answers of its cached resolvers, also where
    a launcher brings the job to another process: all jobs of a multirun share the folder.
    """
    return new_folder(command, "multirun")


def new_folder(command: str, label: str) -> str:
    """Make a folder that no other run has, named by date, time and `label`."""
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + (f"_{label}" if label else "")
    for number in count(1):
        folder = Path("runs", command, name if number == 1 else f"{name}_{number}")
        with suppress(FileExistsError):
            folder.mkdir(parents=True)
            break
    return str(folder)


def job_name(number: int, overrides: Sequence[str]) -> str:
    """Folder of one job of a multirun, by what differs between its jobs: "0_randomization-friction_3_seed-0".

    Signs that a shell or Hydra would take for something else become "-".
    """
    words = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(words)
    constant = {given.get_key_element() for given in parsed if not given.is_sweep_override()}
    swept = (word for word in overrides if "=" in word and word.split("=")[0] not in constant)
    plain = (re.sub(r"[^\w.+-]+", "-", word).strip("-") for word in swept)
    return "_".join((str(number), *plain))[:LONGEST_NAME]


OmegaConf.register_new_resolver("run_folder", run_folder, use_cache=True)
OmegaConf.register_new_resolver("sweep_folder", sweep_folder, use_cache=True)
OmegaConf.register_new_resolver("job_name", job_name)
# conf/emulator/ builds on this one: the settings class is where its numbers stand
ConfigStore.instance().store(group="emulator", name="medium", node=EmulatorSettings().model_dump(mode="json"))
