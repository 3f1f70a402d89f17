"""Shared by the bench scripts: options, commands, run folders, parallel work, JSON files and tables."""

import argparse
import json
import multiprocessing
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from cartpole_rl.files import write_text
from cartpole_rl.reporting.texts import Cell, table
from cartpole_rl.run_folder import AGENT_HASH, file_hash, find_agent, recorded_provenance
from cartpole_rl.workflows.build import use_threads

RUNS = Path("runs/bench")  # the parent of every run folder that a bench script makes
REFERENCES = Path(__file__).with_name("references.json")  # written by reference.py
FIRST_SEED = 10  # of reported trainings; settings were chosen on seeds 0 to 9
AGENT = "run="  # the setting that names an agent
LOST_SCORE = 500  # an episode with a lower score counts as lost
Job = TypeVar("Job")
Result = TypeVar("Result")


def option_parser(page: str | None) -> argparse.ArgumentParser:
    """Return a parser with `--json` whose `--help` shows the script's whole docstring."""
    parser = argparse.ArgumentParser(description=page, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all figures to FILE")
    return parser


def add_seed_options(parser: argparse.ArgumentParser, seeds: int) -> None:
    """Add `--seeds` and `--first-seed`, from which `chosen_seeds` makes the seeds."""
    parser.add_argument("--seeds", type=positive_int, default=seeds, help=f"trainings ({seeds})")
    parser.add_argument(
        "--first-seed",
        type=int,
        default=FIRST_SEED,
        metavar="SEED",
        help=f"of the trainings ({FIRST_SEED}; settings were chosen on seeds below)",
    )


def chosen_seeds(options: argparse.Namespace) -> range:
    """Return the seeds of the options."""
    return range(options.first_seed, options.first_seed + options.seeds)


def positive_int(text: str) -> int:
    """Convert an option to an integer of at least 1."""
    if (value := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"{text} is less than 1")
    return value


def share(text: str) -> float:
    """Convert `--wider` to a number from 0 to 1; beyond 1 some carts would have no mass."""
    if not 0 <= (value := float(text)) <= 1:
        raise argparse.ArgumentTypeError(f"{text} is not a share from 0 to 1")
    return value


def add_wider_option(parser: argparse.ArgumentParser) -> None:
    """Add `--wider`."""
    parser.add_argument(
        "--wider",
        type=share,
        default=0.0,
        metavar="SHARE",
        help="extend each range on both sides by this share of its width, from 0 (default) to 1",
    )


def overrides_of(words: Iterable[str]) -> dict[str, Any]:
    """Return the settings that words such as `learning.carts=16` give."""
    return {name: yaml.safe_load(value) for name, _, value in (word.partition("=") for word in words)}


def failure(command: str, *words: str) -> str | None:
    """Run cartpole-`command`; return None on success, else the last line of its error output."""
    program = Path(sys.executable).with_name(f"cartpole-{command}")
    done = subprocess.run([program, *words], capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return None
    return (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]


def refusal(folder: Path, command: str, *words: str, result: str) -> str | None:
    """Run cartpole-`command` in `folder` unless its `result` file exists; return its error, if it fails.

    Exit if the result was made with other words or of another agent: it would be reported as that of these.
    """
    asked = [*words, f"hydra.run.dir={folder}"]
    if not (folder / result).exists():
        return failure(command, *asked)
    made = recorded_provenance(folder)
    if made.get("command", [])[1:] != asked:
        sys.exit(f"{folder} was made with other settings than {' '.join(words)}; move or delete it")
    check_agent(folder, next((word.removeprefix(AGENT) for word in words if word.startswith(AGENT)), ""))
    print(f"{folder} is reused, of commit {made.get('git_commit')}", file=sys.stderr, flush=True)
    return None


def check_agent(folder: Path, agent: str) -> None:
    """Exit if the run in `folder` is of another checkpoint than its `agent` has now."""
    used = recorded_provenance(folder).get(AGENT_HASH)
    if used and used != file_hash(find_agent(Path(agent))):
        sys.exit(f"{folder} was made with an earlier agent of {agent}; move or delete it")


def run_once(folder: Path, command: str, *words: str, result: str = "metrics.json") -> Path:
    """Run cartpole-`command` in `folder` unless it was run there; exit if it fails or had other words."""
    if error := refusal(folder, command, *words, result=result):
        sys.exit(f"cartpole-{command} in {folder}: {error}")
    return folder


def train_seeds(seeds: Sequence[int], jobs: int, overrides: Sequence[str], parent: Path) -> list[Path]:
    """Train with each of `seeds` in `parent`/<seed>, `jobs` at a time; return the folders."""

    def train(seed: int) -> Path:
        return run_once(parent / str(seed), "train", f"seed={seed}", *overrides)

    return in_parallel(train, seeds, jobs)


def in_parallel(work: Callable[[Job], Result], items: Iterable[Job], jobs: int) -> list[Result]:
    """Return `work(item)` for each item, in order, `jobs` at a time in threads."""
    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(work, items))


def processes(jobs: int) -> ProcessPoolExecutor:
    """Return a pool of `jobs` processes; each computes with one thread."""
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, spawn, initializer=use_threads, initargs=(1,))


def mean_score(file: Path) -> float:
    """Return the mean score (6.2) in a metrics.json."""
    return float(read_json(file)["score"]["mean"])


def reference_scores() -> dict[str, float]:
    """Return the best score known for each plant, from references.json."""
    return {plant: found["score"] for plant, found in read_json(REFERENCES).items()}


def min_median_max(values: Sequence[float], decimals: int) -> dict[str, str]:
    """Return three table cells that summarize one figure over the seeds."""
    found = {"min": np.min(values), "median": np.median(values), "max": np.max(values)}
    return {name: f"{value:.{decimals}f}" for name, value in found.items()}


def print_table(rows: Sequence[Mapping[str, Cell]]) -> None:
    """Print rows with the keys of the first one as headings."""
    print(table(rows, list(rows[0])), flush=True)


def read_json(file: Path) -> Any:
    """Return the content of a JSON file."""
    return json.loads(file.read_text())


def write_json(file: Path | None, content: Any) -> None:
    """Write `content` to a JSON file, a list of numbers in a line; do nothing without a file."""
    if file:
        text = re.sub(
            r"\[[^\[\]{}\"]+\]", lambda numbers: " ".join(numbers[0].split()), json.dumps(content, indent=1)
        )
        write_text(file, text + "\n")
