"""Studies by name: those of conf/study/, or of a folder of a user's own."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.checking import checked, most_similar, similarity
from cartpole_rl.choices import conf_folder
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.settings import Study, setting

STUDIES = conf_folder() / "study"
NEAR = 0.5  # similarity of two names, from which one is suggested for the other


def study_names(source: Path = STUDIES) -> list[str]:
    """Return the names of all studies in `source`, in the order of the page. Raises ConfigError."""
    names = [path.stem for path in source.glob("*.yaml")]
    if not names:
        raise ConfigError(f"{source}: it holds no study")
    return sorted(names, key=lambda name: (load_study(name, source).order, name))


def load_study(name: str, source: Path = STUDIES) -> Study:
    """Return a study of `source`. ConfigError names the nearest study or the mistake."""
    path = source / f"{name}.yaml"
    if not source.is_dir():
        raise ConfigError(f"{source}: there is no such folder of studies")
    if not path.is_file():
        raise ConfigError(unknown("study", name, (other.stem for other in source.glob("*.yaml"))))
    return read_study_file(path)


def read_study_file(file: Path) -> Study:
    """Return the study in a YAML file. Raises ConfigError."""
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
        if not isinstance(values, Mapping):
            raise ConfigError("it holds no study")
        return checked(Study, values)
    except (ConfigError, OSError, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"{file}: {' '.join(str(error).split())}") from None


def unknown(kind: str, name: str, names: Iterable[str]) -> str:
    """Return the message for a name that is none of `names`."""
    known = [*names]
    near = most_similar(name, known) if known else ""
    hint = f"did you mean {near}?" if near and similarity(name, near)[0] > NEAR else "--list names them"
    return f"{name}: there is no such {kind}; {hint}"


def overrides_of(words: Sequence[str], root: Path | None = None) -> dict[str, Any]:
    """Return overrides as on a command line by name, their values as YAML reads them; the last one counts.

    Paths below `root` are taken as they are: a folder's name may hold what means something else in YAML.
    """
    return {setting(word): yaml.safe_load(_quoted(word.partition("=")[2], root)) for word in words}


def _quoted(value: str, root: Path | None) -> str:
    """Return a value with each path below `root` in quotes: a value of its own, or one of a list."""
    if root is None:
        return value
    below = rf"(?<![^\[,\s]){re.escape(f'{root}/')}[^,\]]*[^,\]\s]"
    return re.sub(below, lambda path: json.dumps(path[0], ensure_ascii=False), value)
