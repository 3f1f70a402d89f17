"""Settings composed by Hydra, from conf/ and a user's own files: for the commands and for Python alike.

Beside `cartpole_rl.cli`, the only module that knows Hydra. It takes a tenth of a second to import, so
settings and checks do without it.

A user's own file or mapping becomes a choice in Hydra's ConfigStore, under a name of its own; launchers hand
the ConfigStore to jobs in other processes. What it gives is composed once more as own/<group>, after every
choice and before the command line. So no experiment replaces it, and no friction model's number of the cart.
"""

import re
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import cache, lru_cache
from importlib import import_module
from itertools import chain, count, pairwise
from pathlib import Path
from threading import RLock
from types import TracebackType
from typing import Any, Self

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, QuotedString
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cartpole_rl.checking import (
    NEAR_VALUE,
    most_similar,
    no_such_setting,
    of_another_choice,
    setting_names,
    similarity,
)
from cartpole_rl.choices import (
    OF_CLASSES,
    REPLACES,
    WHOLE,
    Choice,
    Chosen,
    choice,
    conf_folder,
    default_choices,
    group_choices,
    is_own_file,
    is_shipped,
    load,
    merged,
)
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.parameters import PARAMETERS, completed
from cartpole_rl.run_folder import PREFIX, RUN_FILES, USES, check_program, program_of, use_of
from cartpole_rl.terminal import in_quotes

WORD = re.compile(r"([a-z_]+)=(.+)", re.DOTALL)
NAME = re.compile(r"(?!(?:null|true|false|nan|inf)$)[a-z_][\w-]*", re.IGNORECASE | re.ASCII)
OWN = "own"  # the group of what a user's own choices give: own/cart, own/pole, ...
FRICTIONS = ("cart_friction", "pole_friction")  # groups whose `parameters` replace numbers of `cart`
ONE_OF = {  # settings of a group, or of each of its parameters, of which one is given
    "pole": ("choices", "lengths"),
    "agent": ("target_tau", "target_period"),
    "randomization": ("absolute", "relative", "factor"),
}
NO_CHOICE = "{0}=null: a group takes a choice; leave {0}=null out to take the default"
EXTRAS = {  # of the package, that bring launchers and a sweeper
    "hydra/launcher/joblib": "joblib",
    "hydra/launcher/submitit_local": "submitit",
    "hydra/launcher/submitit_slurm": "submitit",
    "hydra/launcher/ray": "ray",
    "hydra/sweeper/optuna": "optuna",
}
DEPRECATED_IN_1_4 = (  # and needed in Hydra 1.3
    r"register_new_resolver\(\) is deprecated",
    "The version_base parameter is deprecated",
    r"hydra\.utils\.instantiate\(\) resolved _target_=",
)
warnings.filterwarnings("ignore", "|".join(DEPRECATED_IN_1_4))
_LOCK = RLock()  # of Hydra's global state


def compose(command: str, overrides: Mapping[str, Any] | Sequence[str] = ()) -> dict[str, Any]:
    """Return the settings of a command, with overrides as on its command line, or by name.

    By name, a group (pole, task, ...) takes the name of a choice, the path of a file, a mapping in its place,
    or a list of these; any other name, dotted or not, takes a value. "+name" adds a setting and "~name"
    removes one. Values that conf/ leaves open ("???") are left out. Raises ConfigError in one line.
    """
    with OwnChoices(command, overrides) as own:
        return composed(command, own.words)


class OwnChoices:
    """A user's own choices in the overrides of a command, in Hydra's ConfigStore until the end of a `with`.

    `words` are the overrides with names in place of files and mappings; `typed` finds the words of a command
    line by these. Raises ConfigError.
    """

    def __init__(self, command: str, overrides: Mapping[str, Any] | Sequence[str]) -> None:
        self.command = command
        self.groups = default_choices(command)
        self.typed: dict[str, str] = {}
        self._own: dict[str, dict[str, dict[str, Any]]] = defaultdict(dict)  # group: name: what it gives
        self._stored: list[tuple[str, str]] = []  # group and name of each, in the ConfigStore
        self._names: dict[str, set[str]] = defaultdict(set)  # chosen, by group
        self._swept: set[str] = set()  # groups of which several choices are given
        self._folder: Path | None = None
        try:
            if isinstance(overrides, Mapping):
                words = [self._override(name, value) for name, value in overrides.items()]
                words = [word for word in words if word]
            else:
                self._folder = own_folder(overrides)
                words = [self._with_names(word) for word in overrides]
                self.typed = dict(zip(words, overrides, strict=True))
            self.words = self._completed(words)
        except BaseException:
            self.remove()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the choices from the ConfigStore."""
        for group, name in self._stored:
            *above, last = group.split("/")
            place = ConfigStore.instance().repo
            for part in above:
                place = place[part]
            del place[last][f"{name}.yaml"]

    def _override(self, name: str, value: Any) -> str:
        """Return a Python value for Hydra's command line; "" where a group stays without a choice."""
        if name not in self.groups:
            return name if name.startswith("~") else f"{name}={as_literal(name, value)}"
        if value is not None:
            return f"{name}={self._name(name, value)}"
        if self.groups[name] is None:
            return ""
        raise ConfigError(NO_CHOICE.format(name))

    def _with_names(self, word: str) -> str:
        """Return an override with names of choices in place of files and mappings."""
        match = WORD.fullmatch(word)
        if match is None or not (conf_folder() / match[1]).is_dir() or match[1] == "hydra":
            return word
        group, text = match[1], match[2]
        if text == "null":
            raise ConfigError(NO_CHOICE.format(group))
        elements = _elements(word, text)
        if elements is None:
            return word
        if len(elements) > 1:
            self._swept.add(group)
        return f"{group}={','.join(self._name(group, each) for each in elements)}"

    def _name(self, group: str, chosen: Any) -> str:
        """Return what stands for one choice, or a list of choices, on Hydra's command line."""
        if isinstance(chosen, list | tuple):
            return self._store(group, "_".join(self._name(group, each) for each in chosen), [*chosen])
        if isinstance(chosen, Mapping):
            return self._store(group, "given", chosen)
        name = chosen.text if isinstance(chosen, QuotedString) else _text(chosen)
        if "${" in name and not is_own_file(name):
            return name
        _check_run_folder(group, name)
        if Path(name).suffix and not is_own_file(name) and Path(name).is_file():
            raise ConfigError(f"{group}={name}: a file of your own must end in .yaml")
        if is_own_file(name):
            return self._store(group, Path(name).stem, Path(name))
        if self._folder is not None and (file := self._folder / group / f"{name}.yaml").is_file():
            return self._store(group, name, file)
        self._names[group].add(name)
        return name if NAME.fullmatch(name) else "'" + name.replace("\\", "\\\\").replace("'", "\\'") + "'"

    def _store(self, group: str, name: str, chosen: Choice) -> str:
        """Read a choice, hand it to Hydra, and return its name there."""
        is_file = isinstance(chosen, Path)
        folder = Path() if is_file or self._folder is None else self._folder / group
        loaded = load(group, chosen, folder)
        if group == "cart":
            _check_cart(f"cart={chosen if is_file else '{...}'}", loaded)
        groups = [{f"{REPLACES}{other}": self._chosen(other, each)} for other, each in loaded.groups.items()]
        values = loaded.values if group in WHOLE else _with_defaults(group, loaded.values)
        node = {"defaults": [*groups, "_self_"], **values} if groups else values
        name = self._free_name(group, name, chosen)
        self._put(group, name, node, "_global_" if group in WHOLE else None)
        self._own[group][name] = loaded.own
        return name

    def _put(self, group: str, name: str, node: Any, package: str | None) -> None:
        ConfigStore.instance().store(name, node, group, package)
        self._stored.append((group, name))

    def _chosen(self, group: str, chosen: Any) -> str | None:
        """Return a choice of another group in an experiment, as Hydra takes it."""
        return self._name(group, chosen).strip("'") if chosen is not None else None

    def _free_name(self, group: str, name: str, chosen: Choice) -> str:
        """Return a name that Hydra reads as text, and that no other choice of the group has."""
        plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
        plain = plain if NAME.fullmatch(plain) else f"file_{plain}"
        names = [plain]
        if isinstance(chosen, Path):
            parent = re.sub(r"\W+", "_", chosen.resolve().parent.name, flags=re.ASCII)
            names.append(f"{parent if NAME.fullmatch(parent) else 'file'}_{plain}")
        stored = ConfigStore.instance().repo.get(group, {})
        taken = {*self._in_folder(group), *(name.removesuffix(".yaml") for name in stored)}
        every = chain(names, (f"{plain}_{number}" for number in count(2)))
        return next(each for each in every if each not in taken and not is_shipped(group, each))

    def _in_folder(self, group: str) -> list[str]:
        """Return the choices of a group in the folder of --config-dir."""
        return [] if self._folder is None else [file.stem for file in (self._folder / group).glob("*.yaml")]

    def _completed(self, words: list[str]) -> list[str]:
        """Return the words, and those by which what the user gave outlasts other choices."""
        typed = {key_of(word) for word in words}
        frictions = [group for group in FRICTIONS if self.groups.get(group) is not None or group in typed]
        last = ("experiment", "sweep", *FRICTIONS)
        own = sorted(self._own.keys() - {"sweep"}, key=lambda group: (group in WHOLE, group in last))
        for group in own:
            shipped = (file.stem for file in (conf_folder() / group).glob("*.yaml"))
            others = {*self._names[group], *shipped, *self._in_folder(group), self.groups.get(group) or ""}
            for name in others | {*self._own[group]}:
                given = self._own[group].get(name, {})
                values = given if group in WHOLE else {group: _alone(group, given)}
                node = merged(_of_the_cart(values, frictions), values) if given else {}
                self._put(f"{OWN}/{group}", name, node, "_global_")
        numbers = {"cart": dict.fromkeys(key[5:] for key in typed if key.startswith("cart."))}
        more = [f"+{OWN}/{group}={self._reference(group)}" for group in own]
        for group, values in _of_the_cart(numbers, frictions).items():
            keys = {f"{group}.parameters.{name}" for name in values["parameters"]}
            more += (
                [] if f"{group}.parameters" in typed else [f"++{key}=null" for key in sorted(keys - typed)]
            )
        place = next((number for number, word in enumerate(words) if key_of(word)), 0)
        return [*words[:place], *more, *words[place:]]

    def _reference(self, group: str) -> str:
        """Return the chosen name for Hydra; a sweep of its own where only the jobs of a sweep have one."""
        in_jobs_alone = group in self._swept and self.groups.get(group) is None
        return f"choice(${{{group}}})" if in_jobs_alone else f"${{{group}}}"


def key_of(word: str) -> str:
    """Return the name in an override: "cart.cart_mass" of "+cart.cart_mass=1"; "" of another word."""
    is_override = not word.startswith("-") and ("=" in word or word.startswith("~"))
    return word.lstrip("+~").partition("=")[0].partition("@")[0] if is_override else ""


def is_completing(word: str) -> bool:
    """Return True for an override that no user gave: one that `OwnChoices` has added."""
    return word.startswith(f"+{OWN}/") or bool(re.fullmatch(r"\+\+\w+_friction\.parameters\.\w+=null", word))


def _of_the_cart(given: Mapping[str, Any], frictions: Iterable[str]) -> dict[str, Any]:
    """Return null for each number of the cart that is given and that a choice of friction replaces."""
    names = given.get("cart") or {}
    found = {group: [name for name in names if name in _replaced_numbers(group)] for group in frictions}
    return {group: {"parameters": dict.fromkeys(numbers)} for group, numbers in found.items() if numbers}


@cache
def _replaced_numbers(friction: str) -> set[str]:
    """Return the numbers of the cart that the choices of a friction in conf/ replace."""
    return {name for each in group_choices(friction).values() for name in each.get("parameters", {})}


def _alone(group: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return what a choice gives, with null for each setting that it excludes."""
    names = ONE_OF.get(group, ())
    if group == "randomization":
        return {name: _excluding(each, names) for name, each in given.items()}
    return _excluding(given, names)


def _excluding(given: Any, names: Iterable[str]) -> Any:
    is_one_given = isinstance(given, Mapping) and any(given.get(name) is not None for name in names)
    return {**dict.fromkeys(names), **given} if is_one_given else given


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


def as_literal(name: str, value: Any) -> str:
    """Return a Python value as Hydra's command line takes it. Raises ConfigError for what it cannot hold."""
    match value:
        case None | bool():
            return _text(value)
        case int() | float():
            return repr(value)
        case str() | Path():
            return in_quotes(str(value))
        case list() | tuple():
            return f"[{','.join(as_literal(name, each) for each in value)}]"
        case Mapping() if all(isinstance(key, str) and re.fullmatch(r"[\w.-]+", key, re.A) for key in value):
            return "{" + ",".join(f"{key}:{as_literal(name, each)}" for key, each in value.items()) + "}"
    raise ConfigError(f"{name}: give numbers, text, true, false, null, lists and mappings of names")


def _elements(word: str, text: str) -> list[Any] | None:
    """Return the choices that a word gives, one or several; None for what Hydra has to read itself."""
    if is_own_file(text) and (Path(text).is_file() or not re.search(r"[\[\](){},'\"]", text)):
        return [Path(text)]
    try:
        (override,) = OverridesParser.create().parse_overrides([word])
    except OverrideParseException:
        parts = text.split(",")
        if any(is_own_file(part) for part in parts):  # with characters that Hydra does not take
            return parts
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
        return merged(_class_defaults("emulator/medium"), values)
    if group == "plant" and values.get("kind") == "serial":
        return merged(_class_defaults("plant//serial_defaults@_here_"), values)
    return values


def _class_defaults(name: str) -> dict[str, Any]:
    """Return the defaults of a settings class, "???" for those that it requires."""
    module, _, attribute = OF_CLASSES[name].partition(":")
    settings = getattr(import_module(module), attribute)
    required = {field: "???" for field, info in settings.model_fields.items() if info.is_required()}
    defaults: dict[str, Any] = settings(**required).model_dump(mode="json")
    return defaults


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
    (pole,) = choice("pole/medium")["choices"].values()  # its numbers are refused with a line of their own
    known = [name for name in PARAMETERS if name not in pole]
    for name in cart.own.keys() - PARAMETERS.keys():
        raise ConfigError(
            f"{word}: {name}: there is no such setting; did you mean {most_similar(name, known)}?"
        )
    if missing := [name for name in known if name not in completed(cart.values)]:
        remedy = "give it, or take what is missing from a choice: defaults: [ip02]"
        raise ConfigError(f"{word}: {missing[0]} is missing; {remedy}")


def composed(command: str, words: Sequence[str]) -> dict[str, Any]:
    """Return the settings of a command, with overrides that name choices. Raises ConfigError in one line."""
    try:
        changes = any("${" in word for word in words)
        find = _composed.__wrapped__ if changes else _composed
        return deepcopy(find(command, tuple(words)))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(error_message(error, command, words)) from None


@lru_cache(maxsize=64)
def _composed(command: str, words: tuple[str, ...]) -> dict[str, Any]:
    with reading_conf():
        return as_mapping(hydra.compose(command, [*words]))


@contextmanager
def reading_conf() -> Iterator[None]:
    """Let `hydra.compose` read conf/, also while a command of Hydra's runs."""
    with _LOCK:
        running = GlobalHydra.instance().hydra
        GlobalHydra.instance().clear()
        try:
            with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
                yield
        finally:
            GlobalHydra.instance().hydra = running


def as_mapping(config: DictConfig) -> dict[str, Any]:
    """Return a composed config, resolved, as plain mappings without the missing values (`???`)."""
    return without_missing(OmegaConf.to_container(config, resolve=True))


def without_missing(values: Any) -> Any:
    """Return nested mappings without the values that are missing ("???")."""
    if not isinstance(values, Mapping):
        return values
    return {name: without_missing(value) for name, value in values.items() if value != "???"}


def error_message(error: Exception, command: str, words: Sequence[str]) -> str:
    """Return an error of Hydra in one line with the remedy."""
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override}: settings are given as key=value, lists as [1,2], "
            "text with special characters in quotes"
        )
    if not isinstance(error, HydraException):
        return next(iter(str(error).splitlines()), type(error).__name__)
    text = " ".join(str(error).split())
    if unknown := re.match(r"Could not override '([^']+)'", text):
        return _unknown_setting(unknown[1], command, words)
    if wrong := re.search(r"Could not find '([^']+)' Available options in '([^']+)': (.*)", text):
        name = wrong[1].removeprefix(f"{wrong[2]}/")
        if extra := EXTRAS.get(wrong[1]):
            return f'{wrong[2]}={name} needs the extra {extra}: pip install "cartpole_rl[{extra}]"'
        remedy = nearest_choice(name, wrong[3].split(" Config search")[0].split())
        return f"{wrong[2]}={name}: there is no such choice; {remedy}"
    if several := re.match(r"Ambiguous value for argument '([^']+)'", text):
        return f"{several[1]}: -m runs each of several values; a list is one value if written [a,b]"
    return text


def _unknown_setting(setting: str, command: str, words: Sequence[str]) -> str:
    """Return the message for a setting that the composed config lacks."""
    group, groups = setting.partition(".")[0], default_choices(command)
    if group not in groups and (conf_folder() / group).is_dir():
        return f"{setting}: cartpole-{command.replace('_', '-')} does not read this group"
    if group in groups and group not in WHOLE:
        if groups[group] is None and group not in map(key_of, words):
            known = ", ".join(group_choices(group))
            return f"{setting}: {group} is not chosen, so it has no settings; give {group}= too: {known}"
        choices = group_choices(group) if group != setting else ()
        if owners := [name for name in choices if setting in known_settings(command, [f"{group}={name}"])]:
            return of_another_choice(setting, owners)
    chosen = [word for word in words if re.fullmatch(r"\w+=[\w.-]+", word)]
    return no_such_setting(setting, known_settings(command, chosen) or known_settings(command, []))


def known_settings(command: str, words: Sequence[str]) -> set[str]:
    """Return the settings of a command, composed with `words`; none if Hydra refuses one of them."""
    try:
        with reading_conf():
            return setting_names(OmegaConf.to_container(hydra.compose(command, [*words]), resolve=False))
    except HydraException:
        return set()


def nearest_choice(wrong: str, choices: Sequence[str]) -> str:
    """Return a hint: the choice that was probably meant, and all choices."""
    near = most_similar(wrong, choices)
    hint = f"did you mean {near}? " if similarity(wrong, near)[0] >= NEAR_VALUE else ""
    return f"{hint}there are {', '.join(choices)}"


OmegaConf.register_new_resolver("constant_settings", list)  # of a command; Hydra 1.3 asks for it always
# conf/emulator/ and conf/plant/serial.yaml extend these
ConfigStore.instance().store("medium", _class_defaults("emulator/medium"), "emulator")
ConfigStore.instance().store("serial_defaults", _class_defaults("plant//serial_defaults@_here_"))
