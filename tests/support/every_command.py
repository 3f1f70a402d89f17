"""Every command with its groups, and what it needs to start; settings by dotted name."""

import os
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from command_line import Outcome, in_process

from cartpole_rl.choices import default_choices
from cartpole_rl.cli import VERBS
from cartpole_rl.command import provide_config
from cartpole_rl.settings import Settings

SCHEMAS: dict[str, type[Settings]] = {name: verb.find(verb.settings) for name, verb in VERBS.items()}
for name, schema in SCHEMAS.items():
    provide_config(name, schema)  # for `compose`
REQUIRED: dict[str, dict[str, Any]] = {
    "evaluate": {"run": "lqr"},
    "record": {"run": "lqr"},
    "finetune": {"run": "some"},
    "model": {"from": "some"},
    "replay": {"from": "some"},
    "import": {"from": "some"},
    "preflight": {"plant.port": "auto"},
    "export": {"format": "firmware"},
    "distill": {"run": "some"},
    "report": {"runs": ["some"]},
}
NOT_ALONE = {"sweep"}  # a sweep makes jobs; those of the package are in test_sweeps.py
GROUPS = [
    (command, group) for command in SCHEMAS for group in default_choices(command) if group not in NOT_ALONE
]
COMMANDS = sorted({command for command, _ in GROUPS})


def leaves(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each number, text, list or empty mapping in nested mappings by its dotted name."""
    for key, value in config.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def run(command: str, *words: str, folder: Path) -> tuple[Outcome, Settings | None]:
    """Compose and check a command's settings as the command does; return the outcome and the settings."""
    found: list[Settings] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        done = in_process(command, *words, folder=folder, function=lambda config: found.append(config))
    return done, found[0] if found else None


def required(command: str) -> list[str]:
    """The words without which a command does not start."""
    return [f"{key}={value}".replace("'", "") for key, value in REQUIRED.get(command, {}).items()]


def contents(folder: Path) -> list[str]:
    return sorted(os.fsencode(path).decode(errors="replace") for path in folder.rglob("*"))


def value_at(config: Settings, path: tuple[str, ...]) -> Any:
    value: Any = config.model_dump(by_alias=True)
    for name in path:
        value = value[name]
    return value
