"""A group's choice may be a file of one's own: cartpole-train cart=runs/identify/<run>/cart.yaml.

Hydra looks for choices in folders that have one folder a group. Such a file is copied into one, under its own
name, and Hydra is told to look there as well. `${here}` in it stands for the folder that the file is in, so
that a run folder can be moved.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from cartpole_rl.choices import conf_folder
from cartpole_rl.errors import ConfigError
from cartpole_rl.workflows.run_folder import PREFIX, USES, check_program, program_of, use_of

HERE = "${here}"
WORD = re.compile(r"^([a-z_]+)=(.+)$")
KEPT = ("config.yaml", "cart.yaml", "pole.yaml", "randomization.yaml")  # files of run folders


@contextmanager
def with_choice_files(words: Sequence[str]) -> Iterator[list[str]]:
    """Overrides in which files have become choices. Raises ConfigError for a file that is missing."""
    with TemporaryDirectory(prefix="cartpole_rl-") as folder:
        given = [_with_choices(word, Path(folder)) for word in words]
        found = any(Path(folder).iterdir())
        yield [*given, f"hydra.searchpath=[file://{folder}]"] if found else list(words)


def _with_choices(word: str, folder: Path) -> str:
    match = WORD.match(word)
    if match is None or not (conf_folder() / match[1]).is_dir():
        return word
    for value in match[2].split(","):
        _check_run_folder(match[1], value)
    if not match[2].endswith((".yaml", ".yml")):
        return word
    names = (
        _copied(value, folder / match[1]) if "/" in value or value.endswith("ml") else value
        for value in match[2].split(",")
    )
    return f"{match[1]}={','.join(names)}"


def _check_run_folder(group: str, value: str) -> None:
    """Raise ConfigError where `value` is a folder, or a file of a run folder that is not for `group`."""
    path = Path(value)
    is_folder = "/" in value and path.is_dir()
    folder = path if is_folder else path.parent
    own, program = folder / f"{group}.yaml", program_of(folder)
    other_file = program is not None and path.name in KEPT and path.name != own.name and path.is_file()
    if not (is_folder or other_file):
        return
    check_program(group, folder, *USES)
    what = f"is a folder, a run of {PREFIX}{program}" if program else "is a folder"
    if other_file:
        what = f"is no {group}, but another file of a run of {PREFIX}{program}"
    if own.is_file():
        raise ConfigError(f"{group}={path} {what}; give {group}={own}")
    use = use_of(folder, program) if program else f"give a file: {group}=mine.yaml"
    raise ConfigError(f"{group}={path} {what}; {use}")


def _copied(value: str, group: Path) -> str:
    """Copy the file `value` to a folder of choices; its name there."""
    file = Path(value)
    if not file.is_file():
        raise ConfigError(f"{group.name}={value}: there is no such file")
    group.mkdir(exist_ok=True)
    name = file.stem
    if (group / f"{name}.yaml").exists():
        name = f"{file.resolve().parent.name}_{name}"
    here = str(file.resolve().parent)
    (group / f"{name}.yaml").write_text(
        file.read_text(encoding="utf-8").replace(HERE, here), encoding="utf-8"
    )
    return name
