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

HERE = "${here}"
WORD = re.compile(r"^([a-z_]+)=(.+\.ya?ml)$")


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
    names = (
        _copied(value, folder / match[1]) if "/" in value or value.endswith("ml") else value
        for value in match[2].split(",")
    )
    return f"{match[1]}={','.join(names)}"


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
