"""Settings from conf/ as a command composes them, but without Hydra; and settings from a checkpoint."""

from collections.abc import Mapping
from typing import Any, TypeVar

from cartpole_rl.checking import checked
from cartpole_rl.choices import compose
from cartpole_rl.errors import CheckpointError, ConfigError
from cartpole_rl.settings import Settings
from cartpole_rl.workflows.config import (
    DistillConfig,
    EvaluateConfig,
    ExportConfig,
    FinetuneConfig,
    IdentifyConfig,
    ModelConfig,
    PreflightConfig,
    RecordConfig,
    ReplayConfig,
    ReportConfig,
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
    ReportConfig: "report",
    ExportConfig: "export",
    DistillConfig: "distill",
}

Config = TypeVar("Config", bound=Settings)


def load_settings(schema: type[Config], overrides: Mapping[str, Any] | None = None) -> Config:
    """Return the settings of conf/ for the command of `schema`, with `overrides` as on its command line.

        load_settings(TrainConfig, {"experiment": "balance", "pole": "large", "learning.carts": 512})

    A group (pole, task, ...) takes the name of its file in conf/, the path of another file, None, or a
    mapping in its place; any other name, dotted or not, takes a value. Raises ConfigError for a missing file,
    an unknown name or a value out of range.
    """
    return checked(schema, compose(COMMANDS[schema], overrides))


def recorded_settings(schema: type[Config], values: Mapping[str, Any], source: str) -> Config:
    """Return the settings in a checkpoint. Raises CheckpointError that names `source` of another version."""
    try:
        return checked(schema, values)
    except ConfigError as error:
        raise CheckpointError(f"{source} is of another version of this package: {error}") from None
