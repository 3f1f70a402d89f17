"""Settings from conf/ for Python: what a command composes with Hydra, composed here without it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from cartpole_rl.checking import checked
from cartpole_rl.choices import choice, default_choices
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.settings import Settings
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
HERE = "${here}"  # the folder of a file of one's own
TRACK = "${oc.select:cart.track_half_length}"  # the only interpolation of conf/'s groups
OF_COMMAND_LINE = ("defaults", "hydra")

Config = TypeVar("Config", bound=Settings)


def load_settings(schema: type[Config], overrides: Mapping[str, Any] | None = None) -> Config:
    """Return the settings of conf/ for the command of `schema`, with `overrides` as on its command line.

        load_settings(TrainConfig, {"experiment": "balance", "pole": "large", "learning.carts": 512})

    A group (pole, task, ...) takes the name of its file in conf/, the path of another file, None, or a
    mapping in its place; any other name, dotted or not, takes a value. Raises ConfigError for a missing file,
    an unknown name or a value out of range.
    """
    command = COMMANDS[schema]
    defaults = {group: name for group, name in default_choices(command).items() if "/" not in group}
    given = {name: value for name, value in (overrides or {}).items() if name in defaults}
    experiment = _load("experiment", given.pop("experiment", None))
    lines: list[dict[str, str]] = experiment.pop("defaults", [])
    replaced = {group.removeprefix("override /"): name for line in lines for group, name in line.items()}
    chosen = {**defaults, **replaced, **given}
    values = {group: _load(group, name) for group, name in chosen.items() if name is not None}
    own = {name: value for name, value in choice(command).items() if name not in OF_COMMAND_LINE}
    values = _merged(_merged(values, own), experiment)
    for name, value in (overrides or {}).items():
        if name not in defaults:
            values = _merged(values, _nested(name, value))
    return checked(schema, _resolved(values))


def _load(group: str, chosen: str | Path | Mapping[str, Any] | None) -> dict[str, Any]:
    """Return a choice of a group as plain data, with the choices of the same group that it builds upon."""
    if chosen is None or isinstance(chosen, Mapping):
        return dict(chosen or {})
    if str(chosen).endswith(".yaml"):
        return _load_file(group, Path(chosen))
    if group == "emulator" and chosen == "medium":  # its numbers are the defaults of the class
        return EmulatorSettings().model_dump(mode="json")
    values = choice(f"{group}/{chosen}") or {}
    if group == "experiment":
        return values
    base: dict[str, Any] = {}
    for name in values.pop("defaults", []):
        base = _merged(base, _load(group, name))
    return _merged(base, values)


def _load_file(group: str, path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{group}={path} cannot be read: {error}") from None
    values: dict[str, Any] = yaml.safe_load(text.replace(HERE, str(path.resolve().parent)))
    return values


def _merged(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `values` in place of its own, nested mappings merged."""
    merged = dict(base)
    for name, value in values.items():
        nested = isinstance(value, Mapping) and isinstance(merged.get(name), Mapping)
        merged[name] = _merged(merged[name], value) if nested else value
    return merged


def _nested(name: str, value: Any) -> dict[str, Any]:
    """Return {"a": {"b": value}} for the name "a.b"."""
    first, _, rest = name.partition(".")
    return {first: _nested(rest, value) if rest else value}


def _resolved(values: dict[str, Any]) -> dict[str, Any]:
    """Return `values` with the track of the cart for TRACK, and without those that are missing ("???")."""
    half_length = values.get("cart", {}).get("track_half_length")
    return _without_missing(
        _merged(values, {"task": {"x_max": half_length}})
        if values.get("task", {}).get("x_max") == TRACK
        else values
    )


def _without_missing(values: Any) -> Any:
    if not isinstance(values, Mapping):
        return values
    return {name: _without_missing(value) for name, value in values.items() if value != "???"}
