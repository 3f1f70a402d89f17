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
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import cache, lru_cache
from importlib import import_module
from itertools import chain, count, pairwise
from pathlib import Path
from threading import RLock
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, QuotedString
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cartpole_rl.checking import (
    most_similar,
    nearest_choice,
    no_such_setting,
    of_another_choice,
    setting_names,
)
from cartpole_rl.choices import (
    OF_CLASSES,
    PORT_KINDS,
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
    read_file,
)
from cartpole_rl.errors import ConfigError, reason_of
from cartpole_rl.rig.hardware import HARDWARE, check_track
from cartpole_rl.rig.parameters import PARAMETERS, check_value, completed
from cartpole_rl.run_folder import (
    CONFIG,
    PREFIX,
    RUN_FILES,
    USES,
    check_program,
    check_resumed,
    program_of,
    use_of,
)
from cartpole_rl.terminal import in_quotes

WORD = re.compile(r"([a-z_]+)=(.+)", re.DOTALL)
NAME = re.compile(r"(?!(?:null|true|false|nan|inf)$)[a-z_][\w-]*", re.IGNORECASE | re.ASCII)
OWN = "own"  # the group of what a user's own choices give: own/cart, own/pole, ...
KEPT = "emulator.given="
MULTIRUN_FLAGS = {"-m", "--multirun"}
RESUMED = ("plant", "learner")  # groups of which a resumed run takes single settings
FRICTIONS = ("cart_friction", "pole_friction")  # groups whose `parameters` replace numbers of `cart`
ONE_OF = {  # settings of a group, or of each of its parameters, of which one is given
    "pole": ("choices", "lengths"),
    "agent": ("target_tau", "target_period"),
    "randomization": ("absolute", "relative", "factor"),
}
IN_PERIODS = {  # settings in seconds: those in control periods that take precedence
    "agent.horizon": "agent.gamma",
    "agent.action_time": "agent.action_gap",
    "learning.return_time": "learning.n_step",
    "task.duration": "task.time_limit",
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
    with hydra_overrides(command, overrides) as (words, _):
        try:
            find = _composed.__wrapped__ if any("${" in word for word in words) else _composed
            return deepcopy(find(command, tuple(words)))
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigError(error_message(error, command, words)) from None


@lru_cache(maxsize=64)
def _composed(command: str, words: tuple[str, ...]) -> dict[str, Any]:
    with reading_conf():
        return as_mapping(hydra.compose(command, [*words]))


@contextmanager
def reading_conf() -> Iterator[None]:
    """Let `hydra.compose` read conf/, also while a command of Hydra's runs, and where warnings are errors."""
    with _LOCK, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "|".join(DEPRECATED_IN_1_4))
        running = GlobalHydra.instance().hydra
        GlobalHydra.instance().clear()
        try:
            with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf_folder())):
                yield
        finally:
            GlobalHydra.instance().hydra = running


def as_mapping(config: DictConfig) -> dict[str, Any]:
    """Return a composed config, resolved, as plain mappings without the missing values (`???`).

    Raises ConfigError for an interpolation that has no value.
    """
    try:
        return without_missing(OmegaConf.to_container(config, resolve=True))
    except OmegaConfBaseException as error:
        reason = reason_of(error)
        raise ConfigError(f"{error.full_key}: {reason}" if error.full_key else reason) from None


def without_missing(values: Any) -> Any:
    """Return nested mappings without the values that are missing ("???")."""
    if not isinstance(values, Mapping):
        return values
    return {name: without_missing(value) for name, value in values.items() if value != "???"}


@contextmanager
def hydra_overrides(
    command: str, overrides: Mapping[str, Any] | Sequence[str]
) -> Iterator[tuple[list[str], dict[str, str]]]:
    """Yield overrides for Hydra, and the words of a command line by these.

    Names of choices take the place of a user's files and mappings, until the end. Raises ConfigError.
    """
    choices = _OwnChoices(command)
    try:
        if isinstance(overrides, Mapping):
            words = [word for name, value in overrides.items() if (word := choices.by_name(name, value))]
            yield choices.completed(words), {}
        else:
            choices.folder = own_folder(overrides)
            words = [choices.with_names(word) for word in overrides]
            yield choices.completed(words), dict(zip(words, overrides, strict=True))
    finally:
        choices.remove()


class _OwnChoices:
    """A user's own choices in the overrides of a command; `folder` is the one of --config-dir."""

    def __init__(self, command: str) -> None:
        self.folder: Path | None = None
        self.groups = default_choices(command)
        self.given: dict[str, dict[str, dict[str, Any]]] = defaultdict(dict)  # group: name: what it gives
        self.names: dict[str, set[str]] = defaultdict(set)  # other choices, by group
        self.swept: set[str] = set()  # groups of which several choices are given
        self.params: list[str] = []  # of the chosen sweep, as words of the command line
        self.stored: list[tuple[str, str]] = []  # group and name of each, in the ConfigStore

    def by_name(self, name: str, value: Any) -> str:
        """Return a Python value for Hydra's command line; "" where a group stays without a choice."""
        if name not in self.groups:
            return name if name.startswith("~") else f"{name}={as_literal(name, value)}"
        if value is not None:
            return f"{name}={self._name(name, value)}"
        if self.groups[name] is None:
            return ""
        raise ConfigError(NO_CHOICE.format(name))

    def with_names(self, word: str) -> str:
        """Return an override of a command line with names of choices in place of files and mappings."""
        if word.startswith("="):  # Hydra takes "" for a group
            raise ConfigError(_no_override(word, ()))
        if re.fullmatch(r"\+*(?!label=)[\w.]+=", word):  # as run=$RUN of a script
            raise ConfigError(f"{word}: the value is missing; give one, or leave {word} out")
        key, _, name = word.partition("=")
        if key == "emulator.cart" and (file := self._in_folder("cart", name)):
            return f"{key}={as_literal(key, file)}"
        match = WORD.fullmatch(word)
        if match is None or not (conf_folder() / match[1]).is_dir() or match[1] == "hydra":
            return word
        group, text = match[1], match[2]
        if group not in self.groups:
            return word  # Hydra refuses it
        if text == "null":
            raise ConfigError(NO_CHOICE.format(group))
        elements = _elements(word, text)
        if elements is None:
            return word
        if len(elements) > 1:
            self.swept.add(group)
        return f"{group}={','.join(self._name(group, each) for each in elements)}"

    def completed(self, words: list[str]) -> list[str]:
        """Return the words, and further ones that keep the user's values over other choices."""
        all_words = [*(self.params if MULTIRUN_FLAGS & {*words} else ()), *words]
        keys = {key_of(word) for word in all_words}
        frictions = [group for group in FRICTIONS if self.groups.get(group) is not None or group in keys]
        groups = sorted(self.given.keys() - {"sweep"}, key=lambda group: (group in WHOLE, group in FRICTIONS))
        more = self._resumed(words)
        for group in groups:
            others = {*self.names[group], *self._found(group), self.groups.get(group) or ""}
            for name in others | {*self.given[group]}:
                given = self.given[group].get(name, {})
                values = given if group in WHOLE else {group: _alone(group, given)}
                nulls = _nulls(_names(values.get("cart")), {each: _replaced(each) for each in frictions})
                node = merged(nulls, values) if given else {}
                self._put(f"{OWN}/{group}", name, node, "_global_")
            in_jobs_alone = group in self.swept and self.groups.get(group) is None
            chosen = f"choice(${{{group}}})" if in_jobs_alone else f"${{{group}}}"
            more.append(f"+{OWN}/{group}={chosen}")
        numbers = [key.removeprefix("cart.") for key in sorted(keys) if key.startswith("cart.")]
        replaced = {
            group: _replaced(group).union(
                *(_names(given.get("parameters")) for given in self.given[group].values())
            )
            for group in frictions
        }
        for group, values in _nulls(numbers, replaced).items():
            names = [f"{group}.parameters.{name}" for name in values["parameters"]]
            if f"{group}.parameters" not in keys:
                more += [f"++{name}=null" for name in names if name not in keys]
        valued = {key_of(word) for word in all_words if not re.search("^~|=null$", word, re.IGNORECASE)}
        more += [
            f"++{periods}=null"
            for seconds, periods in IN_PERIODS.items()
            if seconds in valued and periods not in keys
        ]
        if kept := self._kept_by_emulator(keys):
            more.append(f"{KEPT}[{','.join(kept)}]")
        place = next((number for number, word in enumerate(words) if key_of(word)), 0)
        return [*words[:place], *more, *words[place:]]

    def _resumed(self, words: Sequence[str]) -> list[str]:
        """Return the words for a resumed run's own choices of groups of which single settings are given."""
        given = {key_of(word): word for word in words}
        groups = {key.partition(".")[0] for key in given if "." in key}.intersection(RESUMED) - given.keys()
        runs = _elements(given["resume"], "") if groups and "resume" in given else None
        if runs is None or len(runs) > 1 or runs[0] is None:
            return []
        run = runs[0].text if isinstance(runs[0], QuotedString) else _text(runs[0])
        check_resumed(Path(run))
        recorded = read_file("resume", Path(run) / CONFIG)
        self._put(f"{OWN}/resumed", "resumed", {group: recorded.get(group) for group in groups}, "_global_")
        return [f"+{OWN}/resumed=resumed"]

    def _kept_by_emulator(self, keys: Iterable[str]) -> list[str]:
        """Return the settings of the emulator that the user gave, which no cart's file replaces."""
        on_line = {key.split(".")[1] for key in keys if key.startswith("emulator.")}
        in_files = _names(*self.given["emulator"].values()) if len(self.given["emulator"]) == 1 else set()
        return sorted((on_line | in_files) - {"given"}) if self.groups.get("emulator") else []

    def remove(self) -> None:
        """Remove the choices from the ConfigStore."""
        for group, name in self.stored:
            place = ConfigStore.instance().repo
            for part in group.split("/"):
                place = place[part]
            del place[f"{name}.yaml"]

    def _name(self, group: str, given: Any) -> str:
        """Return what stands for a choice, or a list of choices, on Hydra's command line."""
        chosen = self._chosen(group, given)
        if not isinstance(chosen, str):
            return self._store(group, chosen)
        self.names[group].add(chosen)
        if group == "sweep" and is_shipped(group, chosen):
            self._with_params(choice(f"{group}/{chosen}"))
        if NAME.fullmatch(chosen) or "${" in chosen:
            return chosen
        return "'" + chosen.replace("\\", "\\\\").replace("'", "\\'") + "'"

    def _chosen(self, group: str, given: Any) -> Choice:
        """Return the name of a choice, the path of a file, a mapping, or a list of these."""
        if isinstance(given, list | tuple):
            return [self._chosen(group, each) for each in given]
        if isinstance(given, Mapping):
            return given
        name = given.text if isinstance(given, QuotedString) else _text(given)
        if is_own_file(name):
            _check_run_folder(group, name)
            return Path(name)
        if "${" not in name:
            _check_run_folder(group, name)
            if Path(name).suffix and Path(name).is_file():
                raise ConfigError(f"{group}={name}: a file of your own must end in .yaml")
            return self._in_folder(group, name) or name
        return name

    def _in_folder(self, group: str, name: str) -> Path | None:
        """Return the file of a choice in the folder of --config-dir; None without one."""
        file = self.folder / group / f"{name}.yaml" if self.folder is not None else None
        return file if file and file.is_file() else None

    def _store(self, group: str, chosen: Choice) -> str:
        """Read a choice, hand it to Hydra, and return its name there."""
        folder = self.folder / group if self.folder is not None else Path()
        loaded = load(group, chosen, Path() if isinstance(chosen, Path) else folder)
        if group == "cart":
            _check_cart(f"cart={chosen if isinstance(chosen, Path) else '{...}'}", loaded)
        groups = [
            {f"{REPLACES}{other}": each if each is None else self._name(other, each).strip("'")}
            for other, each in loaded.groups.items()
        ]
        values = loaded.values if group in WHOLE else _with_defaults(group, loaded.values)
        if group == "sweep":
            values = self._with_params(values)
        name = self._free_name(group, chosen)
        node = {"defaults": [*groups, "_self_"], **values} if groups else values
        self._put(group, name, node, "_global_" if group in WHOLE else None)
        self.given[group][name] = loaded.given
        return name

    def _with_params(self, sweep: dict[str, Any]) -> dict[str, Any]:
        """Note the parameters of a sweep; return it with names of choices in place of files among them."""
        params: Any = sweep
        for name in ("hydra", "sweeper", "params"):
            params = params.get(name) if isinstance(params, Mapping) else None
        if not isinstance(params, Mapping):
            return sweep
        words = {name: self.with_names(f"{name}={value}") for name, value in params.items()}
        self.params += words.values()
        texts = {
            name: word.partition("=")[2] for name, word in words.items() if word != f"{name}={params[name]}"
        }
        return merged(sweep, {"hydra": {"sweeper": {"params": texts}}})

    def _put(self, group: str, name: str, node: Any, package: str | None) -> None:
        ConfigStore.instance().store(name, node, group, package)
        self.stored.append((group, name))

    def _free_name(self, group: str, chosen: Choice) -> str:
        """Return a name that Hydra reads as text, and that no other choice of the group has."""
        names = [_plain(chosen)]
        if isinstance(chosen, Path):
            names.append(f"{_plain(chosen.resolve().parent)}_{names[0]}")
        in_store = (name.removesuffix(".yaml") for name in ConfigStore.instance().repo.get(group, {}))
        taken = {*self._found(group), *in_store}
        every = chain(names, (f"{names[0]}_{number}" for number in count(2)))
        return next(each for each in every if each not in taken and not is_shipped(group, each))

    def _found(self, group: str) -> list[str]:
        """Return the choices of a group in conf/ and in the folder of --config-dir."""
        folders = [conf_folder(), *([self.folder] if self.folder is not None else [])]
        return [file.stem for folder in folders for file in (folder / group).glob("*.yaml")]


def _plain(chosen: Choice) -> str:
    """Return a name for a choice."""
    if isinstance(chosen, Mapping):
        return "given"
    if isinstance(chosen, list):
        return "_".join(map(_plain, chosen))
    plain = re.sub(r"\W+", "_", chosen.stem if isinstance(chosen, Path) else str(chosen), flags=re.ASCII)
    return plain.strip("_") if NAME.fullmatch(plain.strip("_")) else f"file_{plain.strip('_')}"


def key_of(word: str) -> str:
    """Return the name in an override: "cart.cart_mass" of "+cart.cart_mass=1"; "" of another word."""
    is_override = not word.startswith("-") and ("=" in word or word.startswith("~"))
    return word.lstrip("+~").partition("=")[0].partition("@")[0] if is_override else ""


def task_overrides(given: list[str] | ListConfig) -> list[str]:
    """Return overrides that Hydra notes, as they were given: `${experiment}` may not be resolved there."""
    words: Any = OmegaConf.to_container(given, resolve=False) if isinstance(given, ListConfig) else given
    return [*words]


def is_completing(word: str) -> bool:
    """Return True for an override that completes others, which no user gave."""
    in_periods = (f"++{name}=null" for name in IN_PERIODS.values())
    return word.startswith((f"+{OWN}/", KEPT)) or bool(
        word in in_periods or re.fullmatch(r"\+\+\w+_friction\.parameters\.\w+=null", word)
    )


def _nulls(numbers: Iterable[str], replaced: Mapping[str, set[str]]) -> dict[str, Any]:
    """Return null for those `numbers` of the cart that a choice of friction has `replaced`, by its group."""
    found = {group: [name for name in numbers if name in names] for group, names in replaced.items()}
    return {group: {"parameters": dict.fromkeys(names)} for group, names in found.items() if names}


@cache
def _replaced(friction: str) -> set[str]:
    """Return the numbers of the cart that the choices of a friction in conf/ replace."""
    return set().union(*(_names(choice.get("parameters")) for choice in group_choices(friction).values()))


def _names(given: Any) -> set[str]:
    return {*given} if isinstance(given, Mapping) else set()


def _alone(group: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return what a choice gives, with null for each setting that it excludes."""
    names = ONE_OF.get(group, ())
    if group == "randomization":
        return {name: _excluding(each, names) for name, each in given.items()}
    valued = [f"{group}.{name}" for name, value in given.items() if value is not None]
    in_periods = [IN_PERIODS[name].partition(".")[2] for name in valued if name in IN_PERIODS]
    return {**dict.fromkeys(in_periods), **_excluding(given, names)}


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
    if group == "plant" and values.get("kind") in PORT_KINDS:
        return merged(_class_defaults(f"plant//{values['kind']}_defaults@_here_"), values)
    return values


def _class_defaults(name: str) -> dict[str, Any]:
    """Return the defaults of a settings class, "???" for those that it requires."""
    module, _, attribute = OF_CLASSES[name].partition(":")
    settings = getattr(import_module(module), attribute)
    required = {field: "???" for field, info in settings.model_fields.items() if info.is_required()}
    unchecked = settings.model_construct(**required)
    defaults: dict[str, Any] = unchecked.model_dump(mode="json", warnings=False)
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
    # the numbers of a pole are refused with a line of their own
    (pole,) = group_choices("pole")["medium"]["choices"].values()
    known = [name for name in PARAMETERS if name not in pole]
    if "choices" in cart.given:
        raise ConfigError(f"{word}: it is the file of a pole; give it as {word.replace('cart=', 'pole=')}")
    for name in cart.given.keys() - PARAMETERS.keys() - {*HARDWARE}:
        nearest = most_similar(name, [*known, *HARDWARE])
        raise ConfigError(f"{word}: {name}: there is no such setting; did you mean {nearest}?")
    numbers = {name: value for name, value in cart.given.items() if isinstance(value, int | float)}
    try:
        for name in numbers.keys() & PARAMETERS.keys():
            check_value(name, numbers[name])
        check_track({**cart.values, **numbers})
    except ConfigError as error:
        raise ConfigError(f"{word}: {str(error).removeprefix('cart.').removeprefix('cart: ')}") from None
    if missing := [name for name in known if name not in completed(cart.values)]:
        remedy = "give it, or take what is missing from a choice: defaults: [ip02]"
        raise ConfigError(f"{word}: {missing[0]} is missing; {remedy}")


def own_file_of(setting: str, words: Sequence[str]) -> str:
    """Return "mine.yaml: " for a setting that a user's own file among the choices `words` gives, else ""."""
    if setting in map(key_of, words):
        return ""
    for word in reversed(words):
        group, _, file = word.partition("=")
        if is_own_file(file) and Path(file).is_file():
            given = load(group, Path(file)).given
            names = setting_names(given if group in WHOLE else {group: given})
            if setting in names:
                return f"{file}: "
    return ""


def error_message(error: Exception, command: str, words: Sequence[str], plants: Collection[str] = ()) -> str:
    """Return an error of Hydra in one line with the remedy; `plants` are those that the command takes."""
    if isinstance(error, OverrideParseException):
        return _no_override(str(error.override), words)
    if not isinstance(error, HydraException):
        return reason_of(error)
    text = " ".join(str(error).split())
    if unknown := re.match(r"Could not override '([^']+)'", text):
        inside = getattr(error.__cause__, "full_key", None) or ""  # the key inside of a mapping
        setting = max(unknown[1], inside, key=len)  # of a group without a choice it is the group alone
        return _unknown_setting(setting, command, words, plants)
    if wrong := re.search(r"Could not find '([^']+)' Available options in '([^']+)': (.*)", text):
        name = wrong[1].removeprefix(f"{wrong[2]}/")
        if extra := EXTRAS.get(wrong[1]):
            return f'{wrong[2]}={name} needs the extra {extra}: pip install "cartpole_rl[{extra}]"'
        if Path(f"{name}.yaml").is_file():
            return f"{wrong[2]}={name}: there is no such choice; did you mean {wrong[2]}={name}.yaml?"
        if wrong[2] in FRICTIONS and ":" in name:
            own = f"give {wrong[2]}=mine.yaml, a file with 'model: {name}' and 'parameters: {{}}'"
            return f"{wrong[2]}={name}: there is no such choice; for a law of your own {own}"
        choices = wrong[3].split(" Config search")[0].split()
        if wrong[2] == "plant" and plants:
            choices = [each for each in choices if each in plants or not is_shipped("plant", each)]
        return f"{wrong[2]}={name}: there is no such choice; {nearest_choice(name, choices)}"
    if several := re.match(r"Ambiguous value for argument '([^']+)'", text):
        return f"{several[1]}: -m runs each of several values; a list is one value if written [a,b]"
    return text


def _no_override(word: str, words: Sequence[str]) -> str:
    """Return the message for a word that is no override, as the first of "experiment medium"."""
    for each, following in pairwise(words):
        if each == word and re.fullmatch(r"[a-z_.]+", word) and re.fullmatch(r"[\w./]+", following):
            return f"{word} {following}: settings are given as key=value; did you mean {word}={following}?"
    return f"{word}: settings are given as key=value, lists as [1,2], text with special characters in quotes"


def _unknown_setting(setting: str, command: str, words: Sequence[str], plants: Collection[str]) -> str:
    """Return the message for a setting that the composed config lacks."""
    group, groups = setting.partition(".")[0], default_choices(command)
    if setting.startswith("layout.keep."):  # takes the name of any column
        return f"{setting}: a new column needs a plus: '+{setting}=[low,high]'"
    if group not in groups and group != "hydra" and (conf_folder() / group).is_dir():
        return f"{setting}: cartpole-{command.replace('_', '-')} does not read this group"
    if group in groups and group not in WHOLE:
        if groups[group] is None and group not in map(key_of, words):
            known = ", ".join(group_choices(group))
            return f"{setting}: {group} is not chosen, so it has no settings; give {group}= too: {known}"
        if setting != group and (owners := _owners(setting)):
            return of_another_choice(setting, owners)
    chosen = [word for word in words if re.fullmatch(r"\w+=[\w.-]+", word)]
    settings = known_settings(command, chosen) or known_settings(command, [])
    of_plant = f"plant.{setting}"
    owners = [each for each in _owners(of_plant) if each in plants]  # as of port=
    if owners and of_plant not in settings:
        return f"{setting}: there is no such setting; {of_another_choice(of_plant, owners)}"
    return no_such_setting(setting, settings | groups.keys())


def _owners(setting: str) -> list[str]:
    """Return the choices of a setting's group that have it."""
    group = setting.partition(".")[0]
    choices = group_choices(group).items()
    named = ((name, setting_names({group: _with_defaults(group, values)})) for name, values in choices)
    return [name for name, names in named if setting in names]


def known_settings(command: str, words: Sequence[str]) -> set[str]:
    """Return the settings of a command, composed with `words`; none if Hydra refuses one of them."""
    try:
        with reading_conf():
            return setting_names(OmegaConf.to_container(hydra.compose(command, [*words]), resolve=False))
    except HydraException:
        return set()


OmegaConf.register_new_resolver("constant_settings", list)  # of a command; Hydra 1.3 asks for it always
# conf/emulator/, conf/plant/serial.yaml, text.yaml and driver.yaml extend these
ConfigStore.instance().store("medium", _class_defaults("emulator/medium"), "emulator")
for _kind in PORT_KINDS:
    ConfigStore.instance().store(f"{_kind}_defaults", _class_defaults(f"plant//{_kind}_defaults@_here_"))
