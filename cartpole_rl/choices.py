"""The choices of conf/ as plain data, for what is built without a command."""

from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.errors import ConfigError


def conf_folder() -> Path:
    """The shipped conf/: inside the package when it was installed as a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def choice(name: str) -> dict[str, Any]:
    """A file of conf/ as it stands there, by its name: "train", "task/swingup". Raises ConfigError."""
    file = conf_folder() / f"{name}.yaml"
    if not file.is_file():
        others = sorted(other.stem for other in file.parent.glob("*.yaml"))
        raise ConfigError(f"no choice {name!r} in conf/; there is {', '.join(others)}")
    return yaml.safe_load(file.read_text(encoding="utf-8"))


def default_choices(command: str) -> dict[str, str]:
    """What a command takes from each group of conf/ unless it is told otherwise: {"cart": "ip02", ...}."""
    lines = choice(command)["defaults"]
    return {group: chosen for line in lines if isinstance(line, dict) for group, chosen in line.items()}
