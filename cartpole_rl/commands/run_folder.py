"""What every run folder holds beside its results: the resolved config, and what it was run with."""

import json
import platform
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.errors import ConfigError

CONFIG, PROVENANCE = "config.yaml", "provenance.json"
PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "numpy", "hydra-core", "mujoco", "pyserial")


def write_config(folder: Path, config: Mapping[str, Any], resumed: bool = False) -> None:
    """config.yaml (resolved) and provenance.json; a resumed run adds to the latter what resumed it.

    Raises ConfigError where the folder holds another run: none is ever overwritten.
    """
    if resumed:
        first = json.loads((folder / PROVENANCE).read_text())
        resumptions = [*first.get("resumed", []), provenance()]
        write_json(folder / PROVENANCE, {**first, "resumed": resumptions})
        return
    if (folder / CONFIG).exists():
        raise ConfigError(f"hydra.run.dir={folder}: it holds a run already; give another folder")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG).write_text(yaml.safe_dump(dict(config), sort_keys=False))
    write_json(folder / PROVENANCE, {"seed": config["seed"], **provenance()})


def provenance() -> dict[str, Any]:
    """Command, versions and commit that a result depends on."""
    return {
        "command": sys.argv,
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "git_commit": git_commit(),
    }


def git_commit() -> str | None:
    """Commit of the checkout the package runs from, "-dirty" if changed; None outside a checkout."""
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / ".git").exists():  # an installed package may lie in somebody else's repository
        return None
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return found.stdout.strip() or None


def write_json(path: Path, content: Any) -> None:
    """Indented JSON, NaN refused."""
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
