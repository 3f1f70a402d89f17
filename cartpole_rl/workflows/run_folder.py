"""What every run folder holds beside its results: the resolved config, and what it was run with.

A run folder says which command made it, so that a command can refuse the folder of another one.
"""

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
from cartpole_rl.learning.checkpoint_files import FOLDER, LAST, RESUME

CONFIG, PROVENANCE, MULTIRUN = "config.yaml", "provenance.json", "multirun.yaml"
METRICS = "metrics.json"
PREFIX = "cartpole-"
USES = {  # command: what can be done with one of its runs
    "train": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "finetune": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "evaluate": "cartpole-evaluate drives one of its episodes again: repeat.run={0}",
    "record": "cartpole-replay, cartpole-identify and cartpole-model take it as from={0}",
    "replay": "its replay.json and figures are its results; cartpole-replay from=... makes others",
    "identify": "cartpole-train takes its files: cart={0}/cart.yaml pole={0}/pole.yaml "
    "randomization={0}/randomization.yaml",
    "model": "cartpole-train, cartpole-evaluate and cartpole-record take it as plant=learned plant.model={0}",
}
PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "numpy", "hydra-core", "mujoco", "pyserial")


def write_config(folder: Path, program: str, config: Mapping[str, Any], resumed: bool = False) -> None:
    """Write config.yaml (resolved) and provenance.json of a run of cartpole-<program>.

    A resumed run adds to the latter what resumed it.

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
    head = {"program": f"{PREFIX}{program}", "seed": config["seed"]}
    write_json(folder / PROVENANCE, {**head, **provenance()})


def program_of(folder: Path) -> str | None:
    """Return the command that made the run in `folder`, as a key of USES; None where none did.

    Runs from before provenance.json named it have it in their command line.
    """
    try:
        told = json.loads((folder / PROVENANCE).read_text())
        named = told.get("program") or Path(told["command"][0]).stem
    except (OSError, ValueError, AttributeError, LookupError, TypeError):
        return None
    name = str(named).removeprefix(PREFIX)
    return name if name in USES else None


def check_program(setting: str, folder: Path, *wanted: str) -> None:
    """Raise ConfigError, with what can be done, where `folder` is a run of another command than `wanted`."""
    if (folder / MULTIRUN).is_file():
        jobs = sorted(path for path in folder.iterdir() if path.is_dir())
        example = f": {setting}={jobs[0]}" if jobs else ""
        raise ConfigError(
            f"{setting}={folder} is a folder of a multirun; give that of one of its jobs{example}"
        )
    program = program_of(folder)
    if program is None or program in wanted:
        return
    right = " or ".join(f"{PREFIX}{name}" for name in wanted)
    raise ConfigError(
        f"{setting}={folder} is a run of {PREFIX}{program}, not of {right}; {use_of(folder, program)}"
    )


def use_of(folder: Path, program: str) -> str:
    """Say what can be done with a run of cartpole-<program>."""
    if program in ("train", "finetune") and not (folder / METRICS).exists():
        if (folder / FOLDER / RESUME).exists():
            return f"{PREFIX}{program} resume={folder} goes on with it"
        return f"it was stopped before its first checkpoint; start {PREFIX}{program} again"
    return USES[program].format(folder)


def has_ended(run: Path) -> bool:
    """Whether a training or fine-tuning came to its end: its results are there and nothing to resume from."""
    results = (run / METRICS).exists() and (run / FOLDER / LAST).exists()
    return results and not (run / FOLDER / RESUME).exists()


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
