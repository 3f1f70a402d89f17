"""A person's own choices: cartpole-train cart=runs/identify/<run>/cart.yaml, or 'randomization={...}'.

Each file and each mapping is read as the Python API reads it, and becomes a choice in Hydra's ConfigStore
under a name of its own. Launchers hand the ConfigStore to jobs in other processes.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, count, pairwise
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, QuotedString
from hydra.errors import OverrideParseException

from cartpole_rl.checking import most_similar
from cartpole_rl.choices import (
    REPLACES,
    WHOLE,
    Choice,
    Chosen,
    after_files,
    conf_folder,
    is_own_file,
    is_shipped,
    load,
    merged,
)
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.rig.parameters import PARAMETERS, completed
from cartpole_rl.run_files import CART, CONFIG, POLE, RANDOMIZATION
from cartpole_rl.workflows.run_folder import PREFIX, USES, check_program, program_of, use_of

WORD = re.compile(r"([a-z_]+)=(.+)", re.DOTALL)
NAME = re.compile(r"(?!(?:null|true|false|nan|inf)$)[a-z_][\w-]*", re.IGNORECASE | re.ASCII)
RUN_FILES = (CONFIG, CART, POLE, RANDOMIZATION)


@contextmanager
def with_choice_files(words: Sequence[str]) -> Iterator[list[str]]:
    """Yield the overrides with files and mappings replaced by the names of choices. Raises ConfigError."""
    own = _OwnChoices(own_folder(words))
    try:
        yield own.replaced(words)
    finally:
        for group, name in own.stored:
            del ConfigStore.instance().repo[group][f"{name}.yaml"]


def own_folder(words: Sequence[str]) -> Path | None:
    """Return the folder of --config-dir. Raises ConfigError if it is none, or if its files are ignored."""
    for word, following in pairwise([*words, ""]):
        option, _, value = word.partition("=")
        searched = re.findall(r"file://([^,\]'\"]+)", word) if option == "hydra.searchpath" else ()
        if missing := [path for path in searched if not Path(path).is_dir()]:
            raise ConfigError(f"{option}: {missing[0]} not found; give a folder")
        if option not in ("--config-dir", "-cd"):
            continue
        folder = Path(value or following)
        if not folder.is_dir():
            raise ConfigError(
                f"--config-dir={folder}: not found; give a folder with one folder for each group"
            )
        for file in sorted(folder.rglob("*.yaml")):
            name = file.relative_to(folder)
            shipped = conf_folder() / name
            if is_shipped(name.parent.as_posix(), name.stem) and not (
                shipped.exists() and shipped.samefile(file)
            ):
                raise ConfigError(
                    f"--config-dir={folder}: {name} has the name of a shipped choice; rename it"
                )
        return folder
    return None


class _OwnChoices:
    """The choices of a person's own on one command line; `folder` is that of --config-dir."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.values: dict[str, Any] = {}  # that the files of each group give
        self.stored: list[tuple[str, str]] = []  # group and name of each, in the ConfigStore

    def replaced(self, words: Sequence[str]) -> list[str]:
        """Return the words with names of choices; those of experiments last: they give way to files."""
        done = {
            word: self._with_names(word) for word in sorted(words, key=lambda word: word.startswith(WHOLE))
        }
        return [done[word] for word in words]

    def _with_names(self, word: str) -> str:
        match = WORD.fullmatch(word)
        if match is None or not (conf_folder() / match[1]).is_dir() or match[1] == "hydra":
            return word
        group, text = match[1], match[2]
        if text == "null":
            raise ConfigError(f"{word}: a group takes a choice; leave {word} out to take the default")
        elements = _elements(word, text)
        if elements is None:
            return word
        return f"{group}={','.join(self._name(group, each) for each in elements)}"

    def _name(self, group: str, chosen: Any) -> str:
        """Return what stands for one choice, or a list of choices, on Hydra's command line."""
        if isinstance(chosen, list):
            return f"[{','.join(self._name(group, each) for each in chosen)}]"
        if isinstance(chosen, dict):
            return self._stored(group, "given", chosen)
        name = chosen.text if isinstance(chosen, QuotedString) else _text(chosen)
        if "${" in name and not is_own_file(name):
            return name
        _check_run_folder(group, name)
        if Path(name).suffix and not is_own_file(name) and Path(name).is_file():
            raise ConfigError(f"{group}={name}: a file of your own must end in .yaml")
        if is_own_file(name):
            return self._stored(group, Path(name).stem, Path(name))
        if self.folder is not None and (file := self.folder / group / f"{name}.yaml").is_file():
            return self._stored(group, name, file)
        if group in WHOLE and is_shipped(group, name):
            return self._stored(group, name, name)
        return name if NAME.fullmatch(name) else "'" + name.replace("\\", "\\\\").replace("'", "\\'") + "'"

    def _stored(self, group: str, name: str, chosen: Choice) -> str:
        """Read a choice, hand it to Hydra, and return its name there."""
        beside = self.folder / group if self.folder is not None else Path()
        loaded = load(group, chosen, *((beside,) if isinstance(chosen, dict) else ()))
        if group == "cart":
            _check_cart(f"cart={'{...}' if isinstance(chosen, dict) else chosen}", loaded)
        groups = [{f"{REPLACES}{other}": self._chosen(other, each)} for other, each in loaded.groups.items()]
        values = after_files(loaded, self.values) if group in WHOLE else _with_defaults(group, loaded.values)
        if isinstance(chosen, str) and values == loaded.values:
            return name  # a shipped experiment that replaces nothing
        if group not in WHOLE:
            self.values = merged(self.values, {group: loaded.own})
        name = self._free_name(group, name, chosen)
        node = {"defaults": [*groups, "_self_"], **values} if groups else values
        package = "_global_" if group in WHOLE else None
        ConfigStore.instance().store(name, node, group, package)
        self.stored.append((group, name))
        return name

    def _chosen(self, group: str, chosen: Any) -> Any:
        """Return a choice of another group in an experiment, as Hydra takes it."""
        if isinstance(chosen, list):
            return [self._chosen(group, each) for each in chosen]
        return self._name(group, str(chosen)).strip("'") if chosen is not None else None

    def _free_name(self, group: str, name: str, chosen: Choice) -> str:
        """Return a name that Hydra reads as text, and that no other choice of the group has."""
        plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
        plain = plain if NAME.fullmatch(plain) else f"file_{plain}"
        names = [plain]
        if isinstance(chosen, Path):
            parent = re.sub(r"\W+", "_", chosen.resolve().parent.name, flags=re.ASCII)
            names.append(f"{parent if NAME.fullmatch(parent) else 'file'}_{plain}")
        stored = ConfigStore.instance().repo.get(group, {})
        for each in chain(names, (f"{plain}_{number}" for number in count(2))):
            in_folder = self.folder is not None and (self.folder / group / f"{each}.yaml").exists()
            if not (is_shipped(group, each) or in_folder or f"{each}.yaml" in stored):
                return each
        raise AssertionError


def _elements(word: str, text: str) -> list[Any] | None:
    """Return the choices that a word gives, one or several; None for what Hydra has to read itself."""
    if is_own_file(text) and (Path(text).is_file() or not re.search(r"[\[\](){},'\"]", text)):
        return [QuotedString(text, None)]  # type: ignore[arg-type]
    try:
        (override,) = OverridesParser.create().parse_overrides([word])
    except OverrideParseException:
        parts = text.split(",")
        if any(is_own_file(part) for part in parts):  # with characters that Hydra does not take
            return [QuotedString(part, None) for part in parts]  # type: ignore[arg-type]
        raise
    value = override._value
    if isinstance(value, ChoiceSweep):
        return list(value.list) if not value.tags and not value.shuffle else None
    return None if override.is_sweep_override() else [value]


def _text(value: Any) -> str:
    """Return a number or a truth value as text, as YAML writes it."""
    return str(value).lower() if isinstance(value, bool) else "null" if value is None else str(value)


def _with_defaults(group: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a choice with the defaults of its settings class: all can be overridden."""
    if group == "emulator":
        return merged(EmulatorSettings().model_dump(mode="json"), values)
    if group == "plant" and values.get("kind") == "serial":
        return merged(SerialSettings(port="???").model_dump(), values)
    return values


def _check_run_folder(group: str, value: str) -> None:
    """Raise ConfigError where `value` is a folder, or a run folder's file of another group."""
    path = Path(value)
    is_folder = "/" in value and path.is_dir()
    folder = path if is_folder else path.parent
    own, program = folder / f"{group}.yaml", program_of(folder)
    other_file = program is not None and path.name in RUN_FILES and path.name != own.name and path.is_file()
    if not (is_folder or other_file):
        return
    check_program(group, folder, *USES)
    what = f"is a folder, a run of {PREFIX}{program}" if program else "is a folder"
    if other_file:
        what = f"is not a {group} but another file of a run of {PREFIX}{program}"
    if own.is_file():
        raise ConfigError(f"{group}={path} {what}; give {group}={own}")
    use = use_of(folder, program) if program else f"give a file: {group}=mine.yaml"
    raise ConfigError(f"{group}={path} {what}; {use}")


def _check_cart(word: str, cart: Chosen) -> None:
    """Raise ConfigError for an unknown parameter of a cart, or a missing one."""
    known = [name for name in PARAMETERS if name not in Pole.model_fields]
    for name in cart.own.keys() - PARAMETERS.keys():
        raise ConfigError(
            f"{word}: {name}: there is no such setting; did you mean {most_similar(name, known)}?"
        )
    if missing := [name for name in known if name not in completed(cart.values)]:
        remedy = "give it, or take what is missing from a choice: defaults: [ip02]"
        raise ConfigError(f"{word}: {missing[0]} is missing; {remedy}")
