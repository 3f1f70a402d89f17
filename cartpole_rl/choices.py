"""The choices in conf/ as plain data, for code that runs without a command."""

from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.errors import ConfigError


def conf_folder() -> Path:
    """Return the conf/ folder: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"


def choice(name: str) -> dict[str, Any]:
    """Return the content of a file in conf/, named like "train" or "task/swingup". Raises ConfigError."""
    file = conf_folder() / f"{name}.yaml"
    if not file.is_file():
        others = sorted(other.stem for other in file.parent.glob("*.yaml"))
        raise ConfigError(f"no choice {name!r} in conf/; choose from {', '.join(others)}")
    return yaml.safe_load(file.read_text(encoding="utf-8"))


def default_choices(command: str) -> dict[str, str]:
    """Return the default choice of each group that a command reads: {"cart": "ip02", ...}."""
    chosen: dict[str, str] = {}
    for line in choice(command)["defaults"]:
        if isinstance(line, dict):
            chosen |= line
        elif line != "_self_":  # another command's config, which this one extends
            chosen |= default_choices(line)
    return {group: name for group, name in chosen.items() if "/" not in group}
