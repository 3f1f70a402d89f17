"""The words of the command line; checks of resume= and repeat=, which take all others from an earlier run."""

import sys
from collections.abc import Collection
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from cartpole_rl.errors import ConfigError
from cartpole_rl.workflows.checks import check_resumable
from cartpole_rl.workflows.config import EvaluateConfig

TAKEN_BY_REPEAT = ("run", "repeat.run", "repeat.episode", "label")


def check_resumption(program: str, resume: str, folder: Path, replaceable: Collection[str] = ()) -> None:
    """Raise CartPoleError where other than `replaceable` settings are given, or the run cannot continue."""
    refuse_others(("resume", *replaceable), "resume uses that run's own config")
    check_resumable(program, resume, folder)


def is_given(group: str) -> bool:
    """Return True if the command line sets something in `group`."""
    return any(_key(word).split(".")[0] == group for word in HydraConfig.get().overrides.task)


def given_in(*groups: str) -> list[str]:
    """Return the words of the command line, as typed, that choose one of `groups` or set something in it."""
    return [word for word in sys.argv[1:] if _key(word).split(".")[0] in groups]


def check_repetition(config: EvaluateConfig) -> None:
    """Raise ConfigError where other settings are given, or there is no such episode."""
    if config.repeat.run is None and config.repeat.episode is None:
        return
    if config.repeat.run is not None:
        refuse_others(TAKEN_BY_REPEAT, "repeat uses that evaluation's own settings")
    from cartpole_rl.workflows.repeating import repetition  # reads numbers by NumPy

    repetition(config)


def refuse_others(allowed: Collection[str], reason: str) -> None:
    """Raise ConfigError that names the settings given on the command line beside those `allowed`."""
    overrides = HydraConfig.get().overrides.task
    if others := [word for word in overrides if {_key(word), _key(word).split(".")[0]}.isdisjoint(allowed)]:
        raise ConfigError(f"{reason}; leave out {', '.join(others)}")


def _key(word: str) -> str:
    return word.lstrip("+").split("=")[0]
