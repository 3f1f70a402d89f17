"""The studies in conf/study/, by name."""

from collections.abc import Sequence
from typing import Any

import yaml

from cartpole_rl.checking import checked, most_similar, similarity
from cartpole_rl.choices import choice, conf_folder
from cartpole_rl.errors import ConfigError
from cartpole_rl.reporting.studies.settings import Study

GROUP = "study"
NEAR = 0.5  # similarity of two names, from which one is suggested for the other


def study_names() -> list[str]:
    """Return the names of all studies, in the order of the page."""
    names = [path.stem for path in (conf_folder() / GROUP).glob("*.yaml")]
    return sorted(names, key=lambda name: (load_study(name).order, name))


def load_study(name: str) -> Study:
    """Return a study. Raises ConfigError that names the nearest study, or what is wrong in its file."""
    if not (conf_folder() / GROUP / f"{name}.yaml").is_file():
        raise ConfigError(
            unknown("study", name, [path.stem for path in (conf_folder() / GROUP).glob("*.yaml")])
        )
    try:
        return checked(Study, choice(f"{GROUP}/{name}"))
    except (ConfigError, yaml.YAMLError) as error:
        raise ConfigError(f"conf/{GROUP}/{name}.yaml: {error}") from None


def unknown(kind: str, name: str, names: Sequence[str]) -> str:
    """Return the message for a name that is none of `names`."""
    near = most_similar(name, names)
    hint = f"did you mean {near}?" if similarity(name, near)[0] > NEAR else "--list names them"
    return f"{name}: there is no such {kind}; {hint}"


def overrides_of(words: Sequence[str]) -> dict[str, Any]:
    """Return overrides as on a command line by name, their values as YAML reads them; the last one counts."""
    pairs = (word.lstrip("+").partition("=") for word in words)
    return {name: yaml.safe_load(value) for name, _, value in pairs}
