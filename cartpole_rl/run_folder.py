"""Run folders: names of their files, config and provenance in each, and the command that wrote it.

A command refuses the run folder of a command whose results it cannot use.
"""

import hashlib
import json
import platform
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import yaml

from cartpole_rl.errors import CheckpointError, ConfigError, RecordingError
from cartpole_rl.files import write_text
from cartpole_rl.terminal import as_value, as_word

CONFIG, PROVENANCE, MULTIRUN = "config.yaml", "provenance.json", "multirun.yaml"
LOG = "log.txt"  # what a run of scripts/reproduce printed
ERROR = "error.txt"  # why a job of a sweep has no result
METRICS = "metrics.json"  # of an evaluation
HISTORY = "history.jsonl"  # of a training: a line for each evaluation
COMPARISON = "comparison.json"  # of a fine-tuning: metrics before and after
PAGE = "page.html"  # of an identification and of a report
TABLE, EPISODES = "runs.csv", "episodes"  # of a report; episodes have the suffix of their format
IDENTIFIED, MODELLED = "identification.json", "model.json"  # results of these commands
FIGURES, RECORDINGS = "figures", "recordings"
ANIMATION, BESIDE_SIMULATION = "episode.gif", "beside_simulation.gif"  # of the first episode
CHECKPOINTS, LAST, BEST, RESUME = "checkpoints", "last.pt", "best.pt", "resume.pt"  # of an agent
START = "start.pt"  # in checkpoints/ of an unfinished fine-tuning: a copy of the agent that it started from
BASELINE = Path("lqr")  # run=lqr is energy and LQR, not a folder
OWN_POLICY = re.compile(r"[a-zA-Z_]\w*(\.\w+)*:[a-zA-Z_]\w*(\.\w+)*")  # run=module:name
PRETRAINED, PRETRAINED_AGENT = "pretrained", "agent.pt"  # run=pretrained/medium is an agent in this package
CART, POLE, RANDOMIZATION, POSTERIOR = "cart.yaml", "pole.yaml", "randomization.yaml", "posterior.npz"
RUN_FILES = (CONFIG, CART, POLE, RANDOMIZATION)
INPUTS = "inputs.json"  # hashes of files, which are named as seen from the run folder

PREFIX = "cartpole-"
AGENT_HASH = "agent_sha256"  # in provenance.json: of the checkpoint that a run started from
USES = {  # command: how its runs can be used
    "train": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "finetune": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "distill": "cartpole-evaluate, cartpole-record and cartpole-finetune take it as run={0}",
    "evaluate": "cartpole-evaluate drives one of its episodes again: repeat.run={0}",
    "record": "cartpole-replay, cartpole-identify and cartpole-model take it as from={0}",
    "import": "cartpole-identify, cartpole-replay and cartpole-model take it as from={0}",
    "replay": f"its results are replay.json and {FIGURES}/; cartpole-replay from=... makes new ones",
    "identify": "cartpole-train takes its files: cart={1} pole={2} randomization={3}",
    "report": f"it is a page to read: {{0}}/{PAGE}",
    "model": "cartpole-train, cartpole-evaluate and cartpole-record take it as plant=learned plant.model={0}",
    "export": "its files are for other programs; cartpole-import from={0} takes recordings back",
}
RESUMABLE = ("train", "finetune")  # commands that continue their runs
RECORDING = ("record", "identify", "finetune", "import")  # commands whose runs hold recordings
PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "numpy", "hydra-core", "mujoco", "pyserial")


def write_config(
    folder: Path,
    program: str,
    config: Mapping[str, Any],
    resumed: bool = False,
    agent: Path | bytes | None = None,
) -> None:
    """Write config.yaml and provenance.json of a run of cartpole-<program>, which starts from `agent`.

    A resumed run adds its provenance to that of the first start, which is begun anew if it is damaged, and
    writes a config.yaml that is missing. Raises ConfigError if a new run would overwrite another one.
    """
    head = {"program": f"{PREFIX}{program}", "seed": config["seed"]}
    if agent:
        head[AGENT_HASH] = file_hash(agent)
    if (folder / CONFIG).exists() and not resumed:
        raise ConfigError(f"hydra.run.dir={folder}: it holds a run already; give another folder")
    if not (folder / CONFIG).exists():
        write_text(folder / CONFIG, yaml.safe_dump(dict(config), sort_keys=False))
    first = {**head, **provenance()}
    if resumed:
        first = recorded_provenance(folder) or first
        first = {**first, "resumed": [*first.get("resumed", []), provenance()]}
    write_json(folder / PROVENANCE, first)


def file_hash(file: Path | bytes) -> str:
    """Return the SHA-256 of a file, or of its content."""
    return hashlib.sha256(file if isinstance(file, bytes) else file.read_bytes()).hexdigest()


def program_of(folder: Path) -> str | None:
    """Return the command that wrote the run in `folder`, as a key of USES; None for any other folder."""
    name = str(recorded_provenance(folder).get("program")).removeprefix(PREFIX)
    return name if name in USES else None


def recorded_provenance(folder: Path) -> dict[str, Any]:
    """Return the provenance.json of the run in `folder`; empty if it is missing or damaged."""
    return read_json(folder / PROVENANCE)


def recorded_config(folder: Path) -> dict[str, Any]:
    """Return the config.yaml of the run in `folder`; empty if it is missing or damaged."""
    try:
        recorded = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return {}
    return recorded if isinstance(recorded, dict) else {}


def check_program(setting: str, folder: Path, *taken: str) -> None:
    """Raise ConfigError if `folder` is a run of a command that is not among `taken`."""
    if (folder / MULTIRUN).is_file():
        jobs = sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")
        if setting == "resume":
            jobs = [job for job in jobs if (job / CHECKPOINTS / RESUME).exists()]
        example = f": {as_word(setting, jobs[0])}" if jobs else ""
        raise ConfigError(
            f"{setting}={folder} is a folder of a multirun; give that of one of its jobs{example}"
        )
    program = program_of(folder)
    if program is None or program in taken:
        return
    right = " or ".join(f"{PREFIX}{name}" for name in taken)
    raise ConfigError(
        f"{setting}={folder} is a run of {PREFIX}{program}, not of {right}; {use_of(folder, program)}"
    )


def use_of(folder: Path, program: str) -> str:
    """Return how a run of cartpole-<program> can be used."""
    if program in RESUMABLE and not (folder / METRICS).exists():
        if (folder / CHECKPOINTS / RESUME).exists():
            return f"{PREFIX}{program} {as_word('resume', folder)} continues it"
        return f"it was stopped before its first {CHECKPOINTS}/{RESUME}; start {PREFIX}{program} again"
    if program == "distill" and not (folder / CHECKPOINTS / LAST).exists():
        return f"it was stopped before its end; start {PREFIX}{program} again"
    if program == "identify" and not (folder / IDENTIFIED).exists():
        again = f"start {PREFIX}{program} again"
        if any((folder / RECORDINGS).glob("*.csv")):
            again = f"{PREFIX}{program} {as_word('from', folder)} reads its recordings"
        return f"it was stopped before its end; {again}"
    if program == "evaluate" and not repeatable(folder):
        return f"its results are {METRICS} and {FIGURES}/"
    return USES[program].format(
        *map(as_value, (folder, folder / CART, folder / POLE, folder / RANDOMIZATION))
    )


def repeatable(folder: Path) -> bool:
    """Return whether an evaluation drove simulated carts, whose episodes can be driven again."""
    return read_json(folder / METRICS).get("plant") == "simulated"


def has_ended(run: Path) -> bool:
    """True if a training or fine-tuning has results and no state to resume from."""
    results = (run / METRICS).exists() and (run / CHECKPOINTS / LAST).exists()
    return results and not (run / CHECKPOINTS / RESUME).exists()


def is_own_policy(run: Path | None) -> bool:
    """Return True if `run` is a policy of one's own: module:name, or an ONNX file."""
    if run is None:
        return False
    return run.suffix == ".onnx" or (bool(OWN_POLICY.fullmatch(str(run))) and not run.exists())


def find_agent(run: Path) -> Path:
    """Return the checkpoint `run` itself, the last one of a run folder, or a pretrained agent.

    Raises CheckpointError.
    """
    if not run.exists() and run.parts[:1] == (PRETRAINED,):
        return find_pretrained(run)
    if not run.exists():
        raise CheckpointError(
            f"run={run}: there is no such file or folder; give a run folder or a checkpoint"
        )
    if run.suffix == ".py":
        raise CheckpointError(f"run={run}: a policy of your own is given as run={run.stem}:<its name>")
    if run.is_file():
        return run
    path = run / CHECKPOINTS / LAST
    if not path.exists():
        raise CheckpointError(f"run={run}: it holds no {CHECKPOINTS}/{LAST}; give the folder of a training")
    return path


def find_pretrained(run: Path) -> Path:
    """Return the checkpoint of a pretrained agent, such as pretrained/medium. Raises CheckpointError."""
    folder = Path(__file__).parent / PRETRAINED
    path = folder.joinpath(*run.parts[1:]) / PRETRAINED_AGENT
    if not path.is_file():
        names = sorted(agent.parent.name for agent in folder.glob(f"*/{PRETRAINED_AGENT}"))
        choices = ", ".join(f"{PRETRAINED}/{name}" for name in names)
        raise CheckpointError(f"run={run}: there is no such pretrained agent; there are {choices}")
    return path


def check_resumed(run: Path) -> None:
    """Raise CheckpointError if the folder `run`, which is to be resumed, does not exist."""
    if not run.is_dir():
        raise CheckpointError(f"resume={run}: there is no such folder; give the run folder of a training")


def find_training(run: Path) -> Path:
    """Return the file to resume the training in the folder `run` from. Raises CheckpointError."""
    check_resumed(run)
    path = run / CHECKPOINTS / RESUME
    if not path.exists():
        raise CheckpointError(
            f"resume={run}: it holds no {CHECKPOINTS}/{RESUME}; give the folder of a training that was "
            "interrupted after its first checkpoint"
        )
    return path


def recordings(source: Path) -> list[Path]:
    """Return `source` itself if it is a file, else the recordings in that folder or run folder.

    Raises RecordingError if there is none, and ConfigError for a run of a command that records nothing.
    """
    if source.is_file():
        return [source]
    check_program("from", source, *RECORDING)
    inner = source / RECORDINGS
    found = sorted((inner if inner.is_dir() else source).glob("*.csv"))
    if not found:
        missing = "it contains no recording" if source.exists() else "there is no such file or folder"
        given = recorded_config(source).get("from")  # of an identification of others' recordings
        usual = "give a run of cartpole-record or cartpole-identify"
        remedy = f"it read those of from={given}" if given else usual
        raise RecordingError(f"from={source}: {missing}; {remedy}")
    return found


def experiments(source: Path) -> dict[str, Path]:
    """Return `recordings` by the names of their experiments, or of their files. Raises the same errors.

    "01_swing" is the experiment swing, unless there is a second one, or a file of that name.
    """
    names = {path: re.sub(r"^\d\d_(?=.)", "", path.stem) for path in recordings(source)}
    taken = Counter([*names.values(), *(path.stem for path, name in names.items() if path.stem != name)])
    return {name if taken[name] == 1 else path.stem: path for path, name in names.items()}


def is_outdated(folder: Path) -> bool:
    """Return True if a run that the run in `folder` needs was made again since, with another result."""
    recorded = read_json(folder / INPUTS)
    there = {folder / name: was for name, was in recorded.items() if (folder / name).is_file()}
    return any(file_hash(file) != was for file, was in there.items())


def provenance() -> dict[str, Any]:
    """Return the command line, the versions and the commit that a result depends on."""
    return {
        "command": sys.argv,
        "python": platform.python_version(),
        "packages": {
            name: next((each.version for each in distributions(name=name)), None) for name in PACKAGES
        },
        "git_commit": git_commit(),
    }


def git_commit() -> str | None:
    """Return the commit of the checkout that runs, "-dirty" if it was changed; None for a wheel."""
    checkout = Path(__file__).resolve().parents[1]
    if not (checkout / ".git").exists():  # git would find a repository around the installed package
        return None
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return found.stdout.strip() or None


def read_json(path: Path) -> dict[str, Any]:
    """Return the mapping in a JSON file; empty if it is missing or damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def write_json(path: Path, content: Any) -> None:
    """Write indented JSON. Raises ValueError for NaN."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")
