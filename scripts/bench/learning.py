#!/usr/bin/env python
"""How well, and how fast, does each experiment learn? Rows of docs/results/learning.md.

    scripts/bench/learning.py medium large --seeds 10 --jobs 2 --json docs/results/data/learning.json

Trains `--seeds` agents of each experiment of conf/experiment, and of a stepper cart at 10 ms, and judges
every last checkpoint. Further words are passed to cartpole-train as overrides. The runs are in
runs/bench/<experiment>/<seed>, with `--device cuda` in runs/bench/<experiment>_cuda/<seed>; one that exists
is not trained again. The other experiments of a JSON file that exists are kept.

A fraction is the mean score over 100 starts on the nominal simulated cart, divided by the best score that
scripts/bench/reference.py found there (references.json). `drawn` is the mean score on a thousand carts of
randomization=wide (of the stepper's, for it), each driven once; `failed` is the share of them with a score
below 500. `end` is the last evaluation over the best one of the last third of the training. Seconds include
compilation, collection, learning and evaluation.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import (
    LOST_SCORE,
    RUNS,
    add_seed_options,
    chosen_seeds,
    min_median_max,
    option_parser,
    print_table,
    read_json,
    reference_scores,
    train_seeds,
    write_json,
)
from numpy.typing import NDArray

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import simulated_env
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import TrainedAgent, trained_agent, use_threads
from cartpole_rl.workflows.config import TrainConfig


class Experiment(NamedTuple):
    """The poles on which agents are judged, what is chosen for their training, and their drawn carts."""

    plants: tuple[str, ...]
    words: tuple[str, ...] = ()  # instead of experiment=<name>
    randomization: str = "wide"


STEPPER = ("cart=stepper", "pole=rod_03", "control_period=0.01", "actions=nine_levels_fine")
EXPERIMENTS = {
    "medium": Experiment(("medium",)),
    "large": Experiment(("large",)),
    "both": Experiment(("medium", "large")),
    "both_blind": Experiment(("medium", "large")),
    "range": Experiment(tuple(f"{length:.1f} m" for length in np.arange(0.2, 1.01, 0.1))),
    "balance": Experiment(("medium",)),
    "recurrent": Experiment(("medium",)),
    "stepper": Experiment(("rod_03",), (*STEPPER, "randomization=stepper"), "stepper"),
}
REACHED, KEPT = 0.9, 0.85  # fractions: the first marks when learning succeeded, the second whether it lasted
STARTS, DRAWN_CARTS = 100, 1000


def judge(folder: Path, plant: str, randomization: str) -> dict[str, float]:
    """Return the last checkpoint's scores with the pole `plant`, on the nominal cart and on drawn ones."""
    agent = trained_agent(folder)
    nominal = agent.training.model_copy(
        update={"randomization": {}, "pole": pole(plant, agent.training.pole)}
    )
    ranges = {name: Range(**line) for name, line in choice(f"randomization/{randomization}").items()}
    episodes = run_agent(agent, nominal, STARTS)
    drawn = scores(run_agent(agent, nominal.model_copy(update={"randomization": ranges}), DRAWN_CARTS))
    return {
        "score": float(scores(episodes).mean()),
        "score_upright": float(np.mean([episode.score_upright.sum() for episode in episodes])),
        "worst_start": float(scores(episodes).min()),
        "drawn": float(drawn.mean()),
        "failed": float((drawn < LOST_SCORE).mean()),
    }


def run_agent(agent: TrainedAgent, settings: TrainConfig, carts: int) -> list[Episode]:
    """Return one episode on each of `carts` simulated carts, with the starts of an evaluation."""
    env = simulated_env(settings, settings.plant, carts, settings.task.evaluation_start, evaluation_seed(1))
    return run_batch(env, agent.policy)


def scores(episodes: list[Episode]) -> NDArray[np.float64]:
    """Return the score (6.2) of each episode."""
    return np.array([episode.score.sum() for episode in episodes])


def pole(plant: str, trained: PoleSettings) -> PoleSettings:
    """Return a plant's pole: one of the agent's choices by name, or a rod of the length in the name."""
    if trained.choices is not None:
        return PoleSettings(choices={plant: trained.choices[plant]})
    return PoleSettings(choices={plant: Pole.rod(float(plant.split()[0]))})


def seed_result(experiment: str, folder: Path, references: dict[str, float]) -> dict[str, Any]:
    """Return the figures of one seed."""
    history = [json.loads(line) for line in (folder / "history.jsonl").read_text().splitlines()]
    plants, _, randomization = EXPERIMENTS[experiment]
    judged = {plant: judge(folder, plant, randomization) for plant in plants}
    reference = float(np.mean([references[plant] for plant in plants]))
    fractions = [record["score"] / reference for record in history]
    measure = "score_upright" if experiment == "balance" else "score"
    ends = [record[measure] for record in history[-math.ceil(len(history) / 3) :]]
    first = next((index for index, fraction in enumerate(fractions) if fraction >= REACHED), None)
    later = [] if first is None else fractions[first + 1 :]
    return {
        "seconds": history[-1]["seconds"],
        "seconds_to_reached": None if first is None else history[first]["seconds"],
        "transitions_to_reached": None if first is None else history[first]["transitions"],
        "end": ends[-1] / max(ends),
        "kept": float(np.mean([fraction > KEPT for fraction in later])) if later else None,
        "plants": {
            plant: {**figures, "fraction": figures["score"] / references[plant]}
            for plant, figures in judged.items()
        },
    }


def summary(experiment: str, results: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return table rows with minimum, median and maximum over the seeds."""
    balance = experiment == "balance"
    figures = {
        f"{key}, {plant}": [each["plants"][plant][key] for each in results]
        for plant in EXPERIMENTS[experiment].plants
        for key in (("score_upright",) if balance else ("fraction", "score", "drawn", "failed"))
    }
    if not balance:
        figures["seconds to 0.9"] = [each["seconds_to_reached"] or float("inf") for each in results]
        figures["kept over 0.85"] = [each["kept"] or 0.0 for each in results]
        figures["last / best of the last third"] = [each["end"] for each in results]
    figures["seconds"] = [each["seconds"] for each in results]
    return [
        {"experiment": experiment, "figure": name, "seeds": str(len(values))}
        | min_median_max(values, decimals=3 if max(values) < 2 else 0)
        for name, values in figures.items()
    ]


def parse_options() -> tuple[argparse.Namespace, list[str]]:
    """Return the command-line options and the overrides for cartpole-train."""
    parser = option_parser(__doc__)
    parser.add_argument("experiments", nargs="+", choices=list(EXPERIMENTS))
    add_seed_options(parser, seeds=10)
    parser.add_argument(
        "--jobs", type=int, default=1, help="trainings at the same time (1); keep 1 to compare seconds"
    )
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="of the training (cpu)")
    return parser.parse_known_args()


def main() -> None:
    """Train, judge, print a table and write the figures."""
    options, overrides = parse_options()
    use_threads(1)
    references, device, rows = reference_scores(), options.device, []
    everything = read_json(options.json) if options.json and options.json.exists() else {}
    for experiment in options.experiments:
        parent = RUNS / (experiment if device == "cpu" else f"{experiment}_{device}")
        chosen = EXPERIMENTS[experiment].words or (f"experiment={experiment}",)
        words = [*chosen, f"device={device}", *overrides]
        folders = train_seeds(chosen_seeds(options), options.jobs, words, parent)
        results = [seed_result(experiment, folder, references) for folder in folders]
        everything[experiment] = dict(zip(map(str, chosen_seeds(options)), results, strict=True))
        rows += summary(experiment, results)
        print_table(rows)
    write_json(options.json, everything)


if __name__ == "__main__":
    main()
