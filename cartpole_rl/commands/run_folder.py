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

PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "numpy", "hydra-core", "mujoco", "pyserial")


def write_config(folder: Path, config: Mapping[str, Any]) -> None:
    """config.yaml (resolved) and provenance.json (command, versions, git commit)."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(dict(config), sort_keys=False))
    write_json(folder / "provenance.json", provenance(config.get("seed")))


def provenance(seed: int | None) -> dict[str, Any]:
    """Seed, versions and commit that a result depends on."""
    return {
        "command": sys.argv,
        "seed": seed,
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "git_commit": git_commit(),
    }


def git_commit() -> str | None:
    """Commit of the checkout the package runs from, "-dirty" if changed; None outside a checkout."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
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
