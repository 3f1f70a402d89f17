"""The choices in conf/ and a person's own, as plain data and composed without a command.

The commands hand a person's own files and mappings to Hydra as they are read here, so both see the same.
"""

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import yaml

from cartpole_rl.errors import ConfigError

HERE = "${here}"  # the folder of a user's own file
INTERPOLATION = re.compile(r"\$\{(?:(oc\.select|oc\.env):)?\s*([\w.]+)\s*\}")
NOT_SETTINGS = ("defaults", "hydra")
WHOLE = ("experiment", "sweep")  # groups without settings of their own: they change those of others
IN_CODE = ("emulator/medium", "plant//serial_defaults@_here_")  # choices that are a class's defaults
OWN_FILES = (".yaml", ".yml")
REPLACES = "override /"

Choice = str | Path | Mapping[str, Any] | Sequence[Any] | None


class Chosen(NamedTuple):
    """The values of a choice, those among them that a person gave, and the choices of an experiment."""

    values: dict[str, Any]
    own: dict[str, Any]
    groups: Mapping[str, Any] = {}  # other groups that it chooses, as in conf/experiment/


class _Loader(yaml.SafeLoader):
    """YAML 1.2 for a person's file: `yes` and `1:30` are text, 1e-3 a number. A name occurs once."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - PyYAML's

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names: set[str] = set()
        for key, _ in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else ""
            if key.tag not in ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge"):
                _refuse(key, f"the name {name or 'of a setting'} must be text, in quotes if it is a number")
            if name in names:
                _refuse(key, f"{name} is given twice; leave one of them out")
            names.add(name)
        return super().construct_mapping(node, deep)

    def construct_decimal(self, node: yaml.ScalarNode) -> int | float:
        text = str(node.value).replace("_", "").lower()
        return int(text) if re.fullmatch(r"[-+]?\d+", text) else float(re.sub(r"\.(inf|nan)$", r"\1", text))


def _refuse(node: yaml.Node, problem: str) -> NoReturn:
    raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


_NUMBER = r"[-+]?(\d[\d_]*(\.[\d_]*)?|\.\d[\d_]*)(e[-+]?\d+)?|[-+]?\.inf|\.nan"
for _tag, _pattern, _first in (
    ("bool", r"true|false", "tTfF"),
    ("int", _NUMBER, "-+.0123456789"),
    ("null", r"~|null|", "~nN\0"),
    ("merge", r"<<", "<"),
):
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_pattern})\Z", re.IGNORECASE), [*_first]
    )
_Loader.yaml_implicit_resolvers[""] = _Loader.yaml_implicit_resolvers.pop("\0")
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_decimal)


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
    return {
        file.stem: load(group, file.stem).values for file in sorted((conf_folder() / group).glob("*.yaml"))
    }


def is_shipped(group: str, name: str) -> bool:
    """Return True if conf/ or a settings class has the choice `name` of `group`."""
    return f"{group}/{name}" in IN_CODE or (conf_folder() / group / f"{name}.yaml").is_file()


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

    A group (pole, task, ...) takes the name of its file in conf/, the path of another file, a mapping in its
    place, a list of these, or None; any other name, dotted or not, takes a value. "+name" adds a setting and
    "~name" removes one. Values that conf/ leaves open ("???") are left out. Raises ConfigError for a missing
    file.
    """
    defaults = default_choices(command)
    given = {name: value for name, value in (overrides or {}).items() if name in defaults}
    experiment = load("experiment", given.pop("experiment", None))
    chosen = {**defaults, **experiment.groups, **given}
    loaded = {group: load(group, name) for group, name in chosen.items() if name is not None}
    values = merged({group: each.values for group, each in loaded.items()}, _own(command))
    values = merged(values, after_files(experiment, {group: each.own for group, each in loaded.items()}))
    for name, value in (overrides or {}).items():
        if name not in defaults:
            values = _overridden(values, name, value)
    return without_missing(_resolved(values, values))


def after_files(experiment: Chosen, files: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of an experiment, except where it would replace what a person's `files` say."""
    return merged(_without(experiment.values, files), experiment.own)


def _without(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested mappings without what `others` has too."""
    kept = {}
    for name, value in values.items():
        if name not in others:
            kept[name] = value
        elif isinstance(value, Mapping) and isinstance(others[name], Mapping):
            kept[name] = _without(value, others[name])
    return kept


def _own(command: str) -> dict[str, Any]:
    """Return a command's own values, with those of the command that it extends."""
    written = choice(command)
    extended = [line for line in written["defaults"] if isinstance(line, str) and line != "_self_"]
    values: dict[str, Any] = {}
    for other in extended:
        values = merged(values, _own(other))
    return merged(values, {name: value for name, value in written.items() if name not in NOT_SETTINGS})


def is_own_file(chosen: Any) -> bool:
    """Return True if a choice is written as a file of a person's own: a path that ends in .yaml."""
    return isinstance(chosen, Path) or (isinstance(chosen, str) and chosen.endswith(OWN_FILES))


def load(group: str, chosen: Choice, folder: Path = Path(), above: tuple[Path, ...] = ()) -> Chosen:
    """Return a choice of a group, with the choices of the same group that it extends. Raises ConfigError.

    A name is that of a choice in conf/, or else of a file in `folder`, that of the file which extends it. The
    files `above` extend this one.
    """
    if chosen is None:
        return Chosen({}, {})
    if isinstance(chosen, list | tuple):
        return _joined([load(group, each, folder, above) for each in chosen])
    if isinstance(chosen, Mapping):
        return _extended(group, chosen, {**chosen}, folder, above, True)
    if f"{group}/{chosen}" in IN_CODE:
        return Chosen({}, {})
    beside = folder / f"{chosen}.yaml"
    if not is_own_file(chosen) and (is_shipped(group, str(chosen)) or not (above and beside.is_file())):
        return _extended(group, chosen, choice(f"{group}/{chosen}") or {}, folder, above, False)
    path = folder / Path(str(chosen)).expanduser() if is_own_file(chosen) else beside
    if path.resolve() in above:
        raise ConfigError(f"{group}={above[0]}: {path} extends itself; extend a choice of another name")
    return _extended(group, path, read_file(group, path), path.parent, (*above, path.resolve()), True)


def _extended(
    group: str, name: Any, values: dict[str, Any], folder: Path, above: tuple[Path, ...], own: bool
) -> Chosen:
    """Return the values of a choice on top of those of the choices that it extends."""
    lines = values.pop("defaults", [])
    this = Chosen(values, values if own else {})
    others = group in WHOLE  # it may choose from other groups
    if not isinstance(lines, list) or not all(_is_line(line, others) for line in lines):
        raise ConfigError(f"{group}={name}: defaults is a list of choices of {group}, as [large]")
    names = lines if "_self_" in lines else [*lines, "_self_"]
    parts = []
    for line in names:
        if line == "_self_":
            parts.append(this)
        elif isinstance(line, str):
            parts.append(load(group, line, folder, above))
        else:
            found = {key.removeprefix(REPLACES): _beside(value, folder) for key, value in line.items()}
            parts.append(Chosen({}, {}, found))
    return _joined(parts)


def _is_line(line: Any, others: bool) -> bool:
    """Return True if a line of a defaults list is a name or, where allowed, chooses from other groups."""
    if isinstance(line, Mapping):
        return others and all(str(key).startswith(REPLACES) for key in line)
    return isinstance(line, str)


def _beside(chosen: Any, folder: Path) -> Any:
    """Return a choice in a person's experiment; a file's path is relative to the folder of the experiment."""
    return folder / chosen if is_own_file(chosen) else chosen


def _joined(parts: Iterable[Chosen]) -> Chosen:
    """Return choices of one group, each on top of those before."""
    values: dict[str, Any] = {}
    own: dict[str, Any] = {}
    groups: dict[str, Any] = {}
    for each in parts:
        values, own, groups = merged(values, each.values), merged(own, each.own), {**groups, **each.groups}
    return Chosen(values, own, groups)


def read_file(group: str, path: Path) -> dict[str, Any]:
    """Return the content of a user's own choice, with its folder in place of HERE.

    Raises ConfigError in one line if it cannot be read or is not a YAML mapping of plain values.
    """
    if not path.is_file():
        what = "it is a folder; give a file" if path.is_dir() else "there is no such file"
        raise ConfigError(f"{group}={path}: {what}")
    try:
        values = yaml.load(path.read_text(encoding="utf-8-sig"), _Loader)
        json.dumps(values)
    except (OSError, UnicodeDecodeError) as error:
        reason = "it is not UTF-8; save it as UTF-8" if isinstance(error, ValueError) else error.strerror
        raise ConfigError(f"{group}={path} cannot be read: {reason}") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{group}={path} is not valid YAML{_where_and_why(error)}") from None
    except (TypeError, ValueError, RecursionError):
        raise ConfigError(
            f"{group}={path}: give numbers, text, true, false, null, lists and mappings"
        ) from None
    if not isinstance(values, dict | None):
        raise ConfigError(f"{group}={path} holds no settings; write each as name: value")
    placed: dict[str, Any] = _mapped(
        values or {}, lambda text: text.replace(HERE, str(path.resolve().parent))
    )
    return placed


def _mapped(values: Any, function: Any) -> Any:
    """Return nested mappings and lists with `function` of each text."""
    if isinstance(values, Mapping):
        return {name: _mapped(value, function) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [_mapped(value, function) for value in values]
    return function(values) if isinstance(values, str) else values


def _where_and_why(error: yaml.YAMLError) -> str:
    """Return the line and the problem of an error of the parser: ", line 3: found undefined alias 'a'"."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f", line {error.problem_mark.line + 1}: {error.problem}"
    return f": {' '.join(str(error).split())}"


def merged(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `values` in place of its own, nested mappings merged."""
    result = dict(base)
    for name, value in values.items():
        nested = isinstance(value, Mapping) and isinstance(result.get(name), Mapping)
        result[name] = merged(result[name], value) if nested else value
    return result


def _overridden(values: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    """Return `values` with one override: a value, an added setting ("+name") or a removed one ("~name")."""
    key = name.lstrip("+~")
    above, _, last = key.rpartition(".")
    place = values
    for part in filter(None, above.split(".")):
        place = place[part] if isinstance(place, Mapping) and isinstance(place.get(part), Mapping) else {}
    if name.startswith("~"):
        if last not in place:
            raise ConfigError(f"{name}: there is no {key} to remove")
        return _removed(values, key.split("."))
    adds = name.startswith("+") and not name.startswith("++")
    if adds and last in place and not isinstance(value, Mapping | list | tuple):
        raise ConfigError(f"{name}: {key} is there already; leave out the +")
    for part in reversed(key.split(".")):
        value = {part: value}
    return merged(values, value)


def _removed(values: Mapping[str, Any], path: Sequence[str]) -> dict[str, Any]:
    """Return nested mappings without the setting at `path`."""
    first, *rest = path
    kept = {name: value for name, value in values.items() if rest or name != first}
    return {**kept, first: _removed(values[first], rest)} if rest else kept


def _resolved(value: Any, values: Mapping[str, Any], above: tuple[str, ...] = ()) -> Any:
    """Return `value` with each interpolation replaced: ${name}, ${oc.select:name} and ${oc.env:NAME}."""

    def found(kind: str | None, name: str) -> Any:
        if kind == "oc.env":
            if name not in os.environ:
                raise ConfigError(f"${{oc.env:{name}}}: there is no such environment variable")
            return os.environ[name]
        place: Any = values
        for part in name.split("."):
            place = place.get(part, _MISSING) if isinstance(place, Mapping) else _MISSING
        if place is _MISSING and kind is None:
            raise ConfigError(f"${{{name}}}: there is no such setting")
        if name in above:
            raise ConfigError(f"${{{name}}} refers to itself; give a value")
        return None if place is _MISSING else _resolved(place, values, (*above, name))

    def replaced(text: str) -> Any:
        if whole := INTERPOLATION.fullmatch(text):
            return found(*whole.groups())
        text = INTERPOLATION.sub(lambda part: str(found(*part.groups())), text)
        if "${" in text:
            raise ConfigError(f"{text}: of interpolations there are ${{name}}, ${{oc.env:NAME}} and {HERE}")
        return text

    return _mapped(value, replaced)


_MISSING = object()


def without_missing(values: Any) -> Any:
    """Return nested mappings without the values that are missing ("???")."""
    if not isinstance(values, Mapping):
        return values
    return {name: without_missing(value) for name, value in values.items() if value != "???"}
