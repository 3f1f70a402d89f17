"""The last lines of a command: where its results are, and the next command to run."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from cartpole_rl.plants.settings import EmulatedSettings, SerialSettings
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.terminal import as_word
from cartpole_rl.workflows.trained_poles import emulated_words

DEFAULT_BAUD = SerialSettings.model_fields["baud"].default


def print_results(folder: Path, files: str, following: str) -> None:
    """Print that `files` are in `folder`, and the command `following`."""
    print(f"{shown(folder)}/{files} are written; next:")
    print(following)


def print_loop_time(override: str | None) -> None:
    """Print the measured loop time of `LinkStatistics.latency_override`, if there is one."""
    if override is not None:
        print(
            "measured loop time as an override of cartpole-train; add the latency that cartpole-preflight "
            f"prints to both numbers: '{override}'"
        )


def shown(path: Path) -> Path:
    """Return `path` relative to the working directory if it is below it."""
    with suppress(ValueError):
        return path.resolve().relative_to(Path.cwd())
    return path


def plant_words(plant: EmulatedSettings | SerialSettings, poles: Sequence[PoleSettings] = ()) -> str:
    """Return the words that choose a cart on the command line, an emulated one with one of `poles`."""
    if isinstance(plant, SerialSettings):
        length = f" plant.pole_length={plant.pole_length:g}" if plant.pole_length else ""
        baud = f" plant.baud={plant.baud}" if plant.baud != DEFAULT_BAUD else ""
        return f"plant=serial {as_word('plant.port', plant.port)}{baud}{length}"
    return emulated_words(poles) if poles else "plant=emulated"
