#!/usr/bin/env python
"""Learning, seed by seed: trains each row of docs/learning.md and judges the last checkpoint of every seed.

    scripts/bench/learning.py medium large --seeds 10 --jobs 2 --json learning.json

A row is an experiment of conf/experiment; overrides are passed to cartpole-train.
Runs go to runs/bench/<row>/<seed> and are not trained again when they are there. A fraction is the mean score
over 20 starts on a nominal cart, divided by the best that scripts/bench/reference.py has found there
(references.json). "Drawn" carts are a thousand of randomization=wide, each driven once; one that scores less
than 500 has failed. Seconds are those of collecting, learning and evaluating, compilation included.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import simulated_env
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.reporting.table import table
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.agents import TrainedAgent, trained_agent
from cartpole_rl.workflows.build import use_threads
from cartpole_rl.workflows.config import TrainConfig

REFERENCES = Path(__file__).with_name("references.json")
ROWS = {  # experiment: plants that it is judged on
    "medium": ("medium",),
    "large": ("large",),
    "both": ("medium", "large"),
    "both_blind": ("medium", "large"),
    "range": tuple(f"{length:.1f} m" for length in np.arange(0.2, 1.01, 0.1)),
    "balance": ("medium",),
    "recurrent": ("medium",),
}
REACHED, KEPT = 0.9, 0.85  # fractions: of the time to it, and over which later evaluations count as kept
STARTS, DRAWN, FAILURE = 20, 1000, 500


def train(row: str, seed: int, overrides: list[str], folder: Path) -> Path:
    """`folder`, with one seed trained in it unless that was done."""
    if not (folder / "metrics.json").exists():
        command = [Path(sys.executable).with_name("cartpole-train"), f"experiment={row}", f"seed={seed}"]
        done = subprocess.run(
            [*command, *overrides, f"hydra.run.dir={folder}"], capture_output=True, text=True, check=False
        )
        if done.returncode:
            sys.exit(f"{row} seed {seed}: {done.stderr.strip().splitlines()[-1]}")
    return folder


def train_all(row: str, seeds: int, jobs: int, overrides: list[str], parent: Path) -> list[Path]:
    """A folder in `parent` for each seed, `jobs` trained at once."""
    with ThreadPoolExecutor(jobs) as pool:
        return list(pool.map(lambda seed: train(row, seed, overrides, parent / str(seed)), range(seeds)))


def judge(folder: Path, plant: str) -> dict[str, float]:
    """Scores of the last checkpoint with the pole `plant`, on the nominal cart and on drawn ones."""
    agent = trained_agent(folder)
    nominal = agent.training.model_copy(
        update={"randomization": {}, "pole": pole(plant, agent.training.pole)}
    )
    wide = {name: Range(**line) for name, line in choice("randomization/wide").items()}
    episodes = driven(agent, nominal, STARTS)
    drawn = scores(driven(agent, nominal.model_copy(update={"randomization": wide}), DRAWN))
    return {
        "score": float(scores(episodes).mean()),
        "score_upright": float(np.mean([episode.score_upright.sum() for episode in episodes])),
        "worst_start": float(scores(episodes).min()),
        "drawn": float(drawn.mean()),
        "failed": float((drawn < FAILURE).mean()),
    }


def driven(agent: TrainedAgent, settings: TrainConfig, carts: int) -> list[Episode]:
    """An episode on each of `carts` simulated carts, from the starts that an evaluation has."""
    env = simulated_env(settings, settings.plant, carts, settings.task.evaluation_start, evaluation_seed(1))
    return run_batch(env, agent.policy)


def scores(episodes: list[Episode]) -> NDArray[np.float64]:
    """The score (6.2) of each."""
    return np.array([episode.score.sum() for episode in episodes])


def pole(plant: str, trained: PoleSettings) -> PoleSettings:
    """The pole of a plant: one of the agent's choices by name, or a rod by its length."""
    if trained.choices is not None:
        return PoleSettings(choices={plant: trained.choices[plant]})
    return PoleSettings(choices={plant: Pole.rod(float(plant.split()[0]))})


def result(row: str, folder: Path, references: dict[str, float]) -> dict[str, Any]:
    """One seed's figures."""
    history = [json.loads(line) for line in (folder / "history.jsonl").read_text().splitlines()]
    scores = {plant: judge(folder, plant) for plant in ROWS[row]}
    reference = float(np.mean([references[plant] for plant in ROWS[row]]))
    course = [record["score"] / reference for record in history]
    first = next((index for index, fraction in enumerate(course) if fraction >= REACHED), None)
    later = [] if first is None else course[first + 1 :]
    return {
        "seconds": history[-1]["seconds"],
        "seconds_to_reached": None if first is None else history[first]["seconds"],
        "transitions_to_reached": None if first is None else history[first]["transitions"],
        "kept": float(np.mean([fraction > KEPT for fraction in later])) if later else None,
        "plants": {
            plant: {**figures, "fraction": figures["score"] / references[plant]}
            for plant, figures in scores.items()
        },
    }


def summary(row: str, results: dict[int, dict[str, Any]]) -> list[dict[str, str]]:
    """Table lines: minimum, median and maximum over the seeds."""
    lines = {}
    for plant in ROWS[row]:
        for key in ("score_upright",) if row == "balance" else ("fraction", "score", "drawn", "failed"):
            lines[f"{key}, {plant}"] = [each["plants"][plant][key] for each in results.values()]
    if row != "balance":
        lines["seconds to 0.9"] = [each["seconds_to_reached"] or float("inf") for each in results.values()]
        lines["kept over 0.85"] = [each["kept"] or 0.0 for each in results.values()]
    lines["seconds"] = [each["seconds"] for each in results.values()]
    return [
        {"row": row, "figure": name, "seeds": str(len(values))}
        | {
            column: f"{of(values):.3f}" if max(values) < 2 else f"{of(values):.0f}"
            for column, of in (("min", np.min), ("median", np.median), ("max", np.max))
        }
        for name, values in lines.items()
    ]


def main() -> None:
    """Train, judge, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="+", choices=list(ROWS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once; 1 where time is measured")
    parser.add_argument("--json", type=Path, help="file for all figures")
    parser.add_argument("overrides", nargs="*", default=[], help=argparse.SUPPRESS)
    given, overrides = parser.parse_known_args()
    use_threads(1)
    found = json.loads(REFERENCES.read_text())
    references = {plant: figures["score"] for plant, figures in found.items()}
    everything, lines = {}, []
    for row in given.rows:
        folders = train_all(row, given.seeds, given.jobs, overrides, Path("runs/bench", row))
        everything[row] = {seed: result(row, folder, references) for seed, folder in enumerate(folders)}
        lines += summary(row, everything[row])
        print(table(lines, {key: key for key in lines[0]}), flush=True)
    if given.json:
        given.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
