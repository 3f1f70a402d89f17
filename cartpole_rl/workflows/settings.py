"""Settings from conf/ for Python: what a command composes with Hydra, composed here without it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from cartpole_rl.choices import choice, conf_folder, default_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings
from cartpole_rl.workflows.checking import checked
from cartpole_rl.workflows.config import (
    EvaluateConfig,
    FinetuneConfig,
    IdentifyConfig,
    ModelConfig,
    PreflightConfig,
    RecordConfig,
    ReplayConfig,
    TrainConfig,
)

COMMANDS: dict[type[Settings], str] = {
    TrainConfig: "train",
    EvaluateConfig: "evaluate",
    RecordConfig: "record",
    ReplayConfig: "replay",
    IdentifyConfig: "identify",
    ModelConfig: "model",
    FinetuneConfig: "finetune",
    PreflightConfig: "preflight",
}
HERE = "${here}"  # the folder of a file that is given as a choice
TRACK = "${oc.select:cart.track_half_length}"  # the only interpolation of conf/'s groups
OF_COMMAND_LINE = ("defaults", "hydra")

Config = TypeVar("Config", bound=Settings)


def load_settings(schema: type[Config], overrides: Mapping[str, Any] | None = None) -> Config:
    """Return the settings that conf/ has for the command of `schema`, with `overrides` as on its command line.

        load_settings(TrainConfig, {"pole": "large", "experiment": "balance", "learning.carts": 512, "seed": 1})

    A group (pole, task, ...) takes the name of a file in conf/, the path of another one, or a mapping; a dotted
    name takes a value. Raises ConfigError for an unknown name and for a value that is out of range.
    """
    command, overrides = COMMANDS[schema], dict(overrides or {})
    chosen = default_choices(command)
    chosen = {group: name for group, name in chosen.items() if "/" not in group}
    for group in list(chosen):
        if group in overrides:
            chosen[group] = overrides.pop(group)
    experiment = _experiment(chosen.pop("experiment", None))
    for line in experiment.pop("defaults", []):
        for override, name in line.items():
            group = override.removeprefix("override /")
            if chosen[group] == default_choices(command)[group]:
                chosen[group] = name
    values = {group: _choice(group, name) for group, name in chosen.items() if name is not None}
    own = {key: value for key, value in choice(command).items() if key not in OF_COMMAND_LINE}
    values = merged(merged(values, own), experiment)
    for key, value in overrides.items():
        values = merged(values, _nested(key, value))
    return checked(schema, _resolved(values))
