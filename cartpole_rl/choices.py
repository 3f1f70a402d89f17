"""The choices in conf/ and a user's own, read one by one as plain data; `composition` composes them."""

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import yaml

from cartpole_rl.checking import nearest_choice
from cartpole_rl.errors import ConfigError
from cartpole_rl.terminal import shown

HERE = "${here}"  # the folder of a person's own file
WHOLE = ("experiment", "sweep")  # groups without settings of their own: they change those of others
OF_CLASSES = {  # choices that are the defaults of a settings class
    "emulator/medium": "cartpole_rl.emulator.settings:EmulatorSettings",
    "plant//serial_defaults@_here_": "cartpole_rl.plants.settings:SerialSettings",
    "plant//text_defaults@_here_": "cartpole_rl.plants.settings:TextSettings",
    "plant//driver_defaults@_here_": "cartpole_rl.plants.settings:DriverSettings",
}
PORT_KINDS = ("serial", "text", "driver")  # the plants whose defaults are those of a class
OWN_FILES = (".yaml", ".yml")
REPLACES = "override /"

Choice = str | Path | Mapping[str, Any] | Sequence[Any] | None


class Chosen(NamedTuple):
    """The values of a choice, those among them that a person gave, and the choices of an experiment."""

    values: dict[str, Any]
    given: dict[str, Any]
    groups: Mapping[str, Any] = {}  # other groups that it chooses, as in conf/experiment/


_FAST_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # PyYAML can lack libyaml


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
    """Return the content of a file in conf/, named like "train" or "task/swingup". Raises ConfigError.

    A choice of a group stands on top of those that it extends.
    """
    group, _, chosen = name.rpartition("/")
    return load(group, chosen).values if group else _content(name)


def _content(name: str) -> dict[str, Any]:
    file = conf_folder() / f"{name}.yaml"
    if not file.is_file():
        others = sorted(other.stem for other in file.parent.glob("*.yaml"))
        raise ConfigError(f"no choice {name!r} in conf/; choose from {', '.join(others)}")
    return yaml.load(file.read_bytes(), _FAST_LOADER)


def group_choices(group: str) -> dict[str, dict[str, Any]]:
    """Return the content of each choice of a group of conf/ by its name; empty for another name."""
    return {
        file.stem: load(group, file.stem).values for file in sorted((conf_folder() / group).glob("*.yaml"))
    }


def is_shipped(group: str, name: str) -> bool:
    """Return True if conf/ or a settings class has the choice `name` of `group`."""
    return f"{group}/{name}" in OF_CLASSES or (conf_folder() / group / f"{name}.yaml").is_file()


def default_choices(command: str) -> dict[str, str | None]:
    """Return the default choice of each group that a command reads: {"cart": "ip02", "task": None, ...}."""
    chosen: dict[str, str | None] = {}
    has_file = (conf_folder() / f"{command}.yaml").is_file()  # a command without one reads no groups
    for line in choice(command)["defaults"] if has_file else ():
        if isinstance(line, dict):
            chosen |= line
        elif line != "_self_":  # another command's config, which this one extends
            chosen |= default_choices(line)
    return {group: name for group, name in chosen.items() if "/" not in group}


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
    if f"{group}/{chosen}" in OF_CLASSES:
        return Chosen({}, {})
    beside = folder / f"{chosen}.yaml"
    if not is_own_file(chosen) and (is_shipped(group, str(chosen)) or not (above and beside.is_file())):
        if above and not is_shipped(group, str(chosen)):
            remedy = nearest_choice(str(chosen), [*group_choices(group)])
            raise ConfigError(f"{group}={shown(above[-1])}: defaults: there is no choice {chosen}; {remedy}")
        return _extended(group, chosen, _content(f"{group}/{chosen}") or {}, folder, above, False)
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
        else:  # a file's path is relative to the folder of the experiment
            found = {key.removeprefix(REPLACES): each for key, each in line.items()}
            beside = {key: folder / each if is_own_file(each) else each for key, each in found.items()}
            parts.append(Chosen({}, {}, beside))
    return _joined(parts)


def _is_line(line: Any, others: bool) -> bool:
    """Return True if a line of a defaults list is a name or, where allowed, chooses from other groups."""
    if isinstance(line, Mapping):
        return others and all(str(key).startswith(REPLACES) for key in line)
    return isinstance(line, str)


def _joined(parts: Iterable[Chosen]) -> Chosen:
    """Return choices of one group, each on top of those before."""
    whole = Chosen({}, {})
    for each in parts:
        values, given = merged(whole.values, each.values), merged(whole.given, each.given)
        whole = Chosen(values, given, {**whole.groups, **each.groups})
    return whole


def read_file(group: str, path: Path) -> dict[str, Any]:
    """Return the content of a user's own choice, with its folder in place of HERE.

    Raises ConfigError in one line if it cannot be read or is not a YAML mapping of plain values.
    """
    if not path.is_file():
        what = "it is a folder; give a file" if path.is_dir() else "there is no such file"
        if (other := path.with_suffix(".yaml")) != path and other.is_file():
            what += f"; did you mean {other}?"
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


def _mapped(values: Any, function: Callable[[str], str]) -> Any:
    """Return nested mappings and lists with `function` of each text."""
    if isinstance(values, Mapping):
        return {name: _mapped(value, function) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [_mapped(value, function) for value in values]
    return function(values) if isinstance(values, str) else values


def _where_and_why(error: yaml.YAMLError) -> str:
    """Return the line and the problem of an error of the parser: ", line 3: found undefined alias 'a'"."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        # what is not closed is noticed below it; a block mapping starts far above its problem
        is_open = error.context_mark is not None and "block" not in str(error.context)
        mark = error.context_mark if is_open else error.problem_mark
        return f", line {mark.line + 1}: {error.problem}"
    return f": {' '.join(str(error).split())}"


def merged(base: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `values` in place of its own, nested mappings merged."""
    result = dict(base)
    for name, value in values.items():
        nested = isinstance(value, Mapping) and isinstance(result.get(name), Mapping)
        result[name] = merged(result[name], value) if nested else value
    return result
