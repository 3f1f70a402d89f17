"""Settings that go with no others: resume= and repeat= take all else from an earlier run."""

from collections.abc import Collection
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from cartpole_rl.errors import ConfigError
from cartpole_rl.workflows.checks import check_resumable
from cartpole_rl.workflows.config import EvaluateConfig

OF_REPETITION = ("run", "repeat.run", "repeat.episode", "label")  # settings that a repetition takes


def check_resumption(program: str, resume: str, folder: Path) -> None:
    """Raise CartPoleError where other settings are given, or nothing is there to go on with."""
    refuse_others(("resume",), "resume goes on with that run's own config")
    check_resumable(program, resume, folder)


def check_repetition(config: EvaluateConfig) -> None:
    """Raise ConfigError where other settings are given, or no such episode is there to be repeated."""
    if config.repeat.run is None and config.repeat.episode is None:
        return
    if config.repeat.run is not None:
        refuse_others(OF_REPETITION, "repeat takes that evaluation's own settings")
    from cartpole_rl.workflows.repeating import repetition  # reads numbers by NumPy

    repetition(config)


def refuse_others(allowed: Collection[str], reason: str) -> None:
    """Raise ConfigError that names the settings given on the command line beside those `allowed`."""
    given = HydraConfig.get().overrides.task
    if others := [word for word in given if word.lstrip("+").split("=")[0] not in allowed]:
        raise ConfigError(f"{reason}; leave out {', '.join(others)}")
