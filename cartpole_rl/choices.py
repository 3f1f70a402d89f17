"""The choices in conf/ as plain data, composed as Hydra composes them, for code without a command."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.errors import ConfigError

HERE = "${here}"  # the folder of a user's own file
TRACK = "${oc.select:cart.track_half_length}"  # the only interpolation in the groups of conf/
NOT_SETTINGS = ("defaults", "hydra")
IN_CODE = ("emulator/medium", "plant//serial_defaults@_here_")  # choices that are a class's defaults

Choice = str | Path | Mapping[str, Any] | None


def conf_folder() -> Path:
    """Return the conf/ folder: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def choice(name: str) -> dict[str, Any]:
    """Return the content of a file in conf/, named like "train" or "task/swingup". Raises ConfigError."""
    file = conf_folder() / f"{name}.yaml"
    if not file.is_file():
        others = sorted(other.stem for other in file.parent.glob("*.yaml"))
        raise ConfigError(f"no choice {name!r} in conf/; choose from {', '.join(others)}")
    return yaml.safe_load(file.read_text(encoding="utf-8"))


def group_choices(group: str) -> dict[str, dict[str, Any]]:
    """Return the content of each choice of a group of conf/ by its name; empty for another name."""
    return {file.stem: _load(group, file.stem) for file in sorted((conf_folder() / group).glob("*.yaml"))}


def default_choices(command: str) -> dict[str, str | None]:
    """Return the default choice of each group that a command reads: {"cart": "ip02", "task": None, ...}."""
    chosen: dict[str, str | None] = {}
    for line in choice(command)["defaults"]:
        if isinstance(line, dict):
            chosen |= line
        elif line != "_self_":  # another command's config, which this one extends
            chosen |= default_choices(line)
    return {group: name for group, name in chosen.items() if "/" not in group}


def compose(command: str, overrides: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the settings of a command, as Hydra composes them, with `overrides` as on its command line.

    A group (pole, task, ...) takes the name of its file in conf/, the path of another file, None, or a
    mapping in its place; any other name, dotted or not, takes a value. Values that conf/ leaves open ("???")
    are left out. Raises ConfigError for a missing file.
    """
    defaults = default_choices(command)
    given = {name: value for name, value in (overrides or {}).items() if name in defaults}
    replaced, experiment = _experiment(given.pop("experiment", None))
    chosen = {**defaults, **replaced, **given}
    values = {group: _load(group, name) for group, name in chosen.items() if name is not None}
    values = _merged(_merged(values, _own(command)), experiment)
    for name, value in (overrides or {}).items():
        if name not in defaults:
            values = _merged(values, _nested(name, value))
    return _resolved(values)


def _experiment(chosen: Choice) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the choices of an experiment by group, and its values, with those that it extends."""
    values = _load("experiment", chosen)
    choices: dict[str, str] = {}
    extended: dict[str, Any] = {}
    for line in values.pop("defaults", []):
        if isinstance(line, str):  # another experiment
            others, more = _experiment(line)
            choices, extended = {**choices, **others}, _merged(extended, more)
        else:
            choices |= {group.removeprefix("override /"): name for group, name in line.items()}
    return choices, _merged(extended, values)


def _own(command: str) -> dict[str, Any]:
    """Return a command's own values, with those of the command that it extends."""
    written = choice(command)
    extended = [line for line in written["defaults"] if isinstance(line, str) and line != "_self_"]
    values: dict[str, Any] = {}
    for other in extended:
        values = _merged(values, _own(other))
    return _merged(values, {name: value for name, value in written.items() if name not in NOT_SETTINGS})


def _load(group: str, chosen: Choice) -> dict[str, Any]:
    """Return a choice of a group as plain data, with the choices of the same group that it extends."""
    if chosen is None or isinstance(chosen, Mapping):
        return dict(chosen or {})
    if f"{group}/{chosen}" in IN_CODE:
        return {}
    is_file = str(chosen).endswith((".yaml", ".yml"))
    values = _load_file(group, Path(chosen)) if is_file else choice(f"{group}/{chosen}") or {}
    if group == "experiment":
        return values
    extended = values.pop("defaults", [])
    if not isinstance(extended, list) or not all(isinstance(name, str) for name in extended):
        raise ConfigError(f"{group}={chosen}: defaults is a list of choices of {group}, as [large]")
    base: dict[str, Any] = {}
    for name in extended if "_self_" in extended else [*extended, "_self_"]:
        base = _merged(base, values if name == "_self_" else _load(group, name))
    return base


def _load_file(group: str, path: Path) -> dict[str, Any]:
    values: dict[str, Any] = yaml.safe_load(file_text(group, path)) or {}
    return values


def file_text(group: str, path: Path) -> str:
    """Return the text of a user's own choice, with its folder in place of HERE.

    Raises ConfigError in one line if it cannot be read or is not a YAML mapping.
    """
    try:
        text = path.read_text(encoding="utf-8").replace(HERE, str(path.resolve().parent))
        values = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{group}={path} cannot be read: {error}") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{group}={path} is not valid YAML{_where_and_why(error)}") from None
    if not isinstance(values, dict | None):
        raise ConfigError(f"{group}={path} holds no settings; write each as name: value")
    return text


def _where_and_why(error: yaml.YAMLError) -> str:
    """Return the line and the problem of an error of the parser: ", line 3: found undefined alias 'a'"."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f", line {error.problem_mark.line + 1}: {error.problem}"
    return f": {' '.join(str(error).split())}"


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
    return without_missing(
        _merged(values, {"task": {"x_max": half_length}})
        if values.get("task", {}).get("x_max") == TRACK
        else values
    )


def without_missing(values: Any) -> Any:
    """Return nested mappings without the values that are missing ("???")."""
    if not isinstance(values, Mapping):
        return values
    return {name: without_missing(value) for name, value in values.items() if value != "???"}
