"""Files as choices of a group: cartpole-train cart=runs/identify/<run>/cart.yaml.

Hydra finds choices in folders with a subfolder for each group. The file is copied into such a folder, which
is added to Hydra's search path. `${here}` in it stands for the file's folder, so run folders can be moved.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

from cartpole_rl.checking import most_similar
from cartpole_rl.choices import conf_folder, file_text
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.bounds import BOUNDS
from cartpole_rl.randomization.poles import Pole
from cartpole_rl.run_files import CART, CONFIG, POLE, RANDOMIZATION
from cartpole_rl.workflows.run_folder import PREFIX, USES, check_program, program_of, use_of

WORD = re.compile(r"^([a-z_]+)=(.+)$")
SUFFIXES = (".yaml", ".yml")
RUN_FILES = (CONFIG, CART, POLE, RANDOMIZATION)


@contextmanager
def with_choice_files(words: Sequence[str]) -> Iterator[list[str]]:
    """Yield the overrides with files replaced by choices. Raises ConfigError for a wrong file or null."""
    several = not {"-m", "--multirun"}.isdisjoint(words)
    above = Path.cwd() if several else None  # the machines of a cluster may share it
    with TemporaryDirectory(prefix="cartpole_rl-", dir=above) as folder:
        replaced = [_with_choices(word, Path(folder)) for word in words]
        if any(Path(folder).iterdir()):  # beside a file: Hydra takes no override after an option
            files = [number for number, word in enumerate(words) if word != replaced[number]]
            replaced.insert(files[-1] + 1, f"hydra.searchpath=[file://{folder}]")
        yield replaced


def _with_choices(word: str, folder: Path) -> str:
    match = WORD.match(word)
    if match is None or not (conf_folder() / match[1]).is_dir():
        return word
    if match[2] == "null":
        raise ConfigError(f"{word}: a group takes a choice; leave {word} out to take the default")
    for value in match[2].split(","):
        _check_run_folder(match[1], value)
        if Path(value).suffix and not value.endswith(SUFFIXES) and Path(value).is_file():
            raise ConfigError(f"{match[1]}={value}: a file of your own must end in .yaml")
    if not any(value.endswith(SUFFIXES) for value in match[2].split(",")):
        return word
    names = (
        _copied(value, folder / match[1]) if "/" in value or value.endswith(SUFFIXES) else value
        for value in match[2].split(",")
    )
    return f"{match[1]}={','.join(names)}"


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


def _copied(value: str, group: Path) -> str:
    """Copy the file `value` to a folder of choices, and return its name there."""
    file = Path(value)
    if not file.is_file():
        raise ConfigError(f"{group.name}={value}: there is no such file")
    group.mkdir(exist_ok=True)
    text = file_text(group.name, file)
    if group.name == "cart":
        _check_cart(value, yaml.safe_load(text) or {})
    name = file.stem
    if (group / f"{name}.yaml").exists():
        name = f"{file.resolve().parent.name}_{name}"
    (group / f"{name}.yaml").write_text(text, encoding="utf-8")
    return name


def _check_cart(file: str, values: Mapping[str, Any]) -> None:
    """Raise ConfigError for an unknown parameter of a cart, or a missing one in a file that extends none."""
    known = [name for name in BOUNDS if name not in Pole.model_fields]
    for name in values.keys() - BOUNDS.keys() - {"defaults"}:
        near = most_similar(name, known)
        raise ConfigError(f"cart={file}: {name}: there is no such setting; did you mean {near}?")
    missing = [name for name in known if name not in values]
    if missing and "defaults" not in values:
        remedy = "give it, or take what is missing from a choice: defaults: [ip02]"
        raise ConfigError(f"cart={file}: {missing[0]} is missing; {remedy}")
