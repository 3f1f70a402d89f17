#!/usr/bin/env python
"""How well do agents drive emulated carts that they never saw?

    scripts/bench/zero_shot.py runs/train/a runs/train/b --truths 20 --starts 5 --jobs 2 --json zero_shot.json
    scripts/bench/zero_shot.py runs/train/a runs/train/b --wider 0.333 --json wider.json

The last checkpoint of each agent drives the same `--truths` carts, `--starts` episodes on each. Every cart
is a separate process with MuJoCo physics, driven over its serial port. A ratio is a score divided by the
same agent's mean score over 20 starts on the nominal simulated cart. An episode with a score below 500 is
lost. An episode that cannot be driven, because homing fails, has no score and is counted separately.

The carts are drawn inside the ranges of `randomization=wide`, except for the stiction ratio, which training
does not vary. With `--wider` most carts have some numbers outside those ranges. Settings were compared on
the carts of `--seed 0`, so scores on those carts are biased: report the carts of another seed.

The JSON file is written after each agent. If it exists, the agents that it holds are not driven again.
"""

import argparse
import json
import math
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from common import LOST_SCORE, option_parser, positive_int, print_table, read_json, write_json
from numpy.typing import NDArray
from truths import COMPARED, REPORTED, Truth, draw_truths

from cartpole_rl.checking import checked
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import PlantError
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.reporting.table import Cell
from cartpole_rl.workflows.agents import TrainedAgent, trained_agent
from cartpole_rl.workflows.build import evaluated_env, evaluated_settings, use_threads
from cartpole_rl.workflows.config import EvaluateConfig

NOMINAL_STARTS = 20
DRAW = ("truths", "starts", "seed", "wider")  # the options that decide which episodes are driven


@cache
def agent_of(run: Path) -> TrainedAgent:
    """Return the agent of a run folder's last checkpoint."""
    return trained_agent(run)


def mean_score(run: Path, plant: dict[str, Any], truth: Truth, episodes: int, seed: int = 1) -> float:
    """Return the mean score of the agent's last checkpoint on a plant; the seed decides the starts."""
    settings = {
        "run": run,
        "episodes": episodes,
        "plant": plant,
        "emulator": EmulatorSettings(**truth),
        "randomization": {},
        "parameters": None,
        "seed": seed,
        "label": "",
        "threads": 1,
    }
    config, agent = checked(EvaluateConfig, settings), agent_of(run)
    with closing(evaluated_env(evaluated_settings(agent.training, config), config, print)) as env:
        return float(np.mean([each.score.sum() for each in run_episodes(env, agent.policy, episodes)]))


def emulated_score(run: Path, job: tuple[Truth, int]) -> float:
    """Return the score of one episode, given (truth, seed); NaN if the cart cannot be driven."""
    truth, seed = job
    try:
        return mean_score(run, {"kind": "emulated"}, truth, 1, seed)
    except PlantError as error:  # high friction can prevent homing
        print(f"not driven, seed {seed}: {error}; {json.dumps(truth)}", flush=True)
        return math.nan


def emulated_scores(run: Path, truths: Sequence[Truth], starts: int, jobs: int) -> NDArray[np.float64]:
    """Return scores [truths, starts], driving `jobs` carts at once; NaN for episodes that were not driven."""
    work = [(truth, 1 + start) for truth in truths for start in range(starts)]
    drive = partial(emulated_score, run)
    if jobs == 1:
        return np.reshape(list(map(drive, work)), (len(truths), starts))
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawn, initializer=use_threads, initargs=(1,)) as pool:
        return np.reshape(list(pool.map(drive, work)), (len(truths), starts))


def judge(run: Path, draw: dict[str, Any], truths: list[Truth], jobs: int) -> dict[str, Any]:
    """Return all figures of one agent, as the JSON file holds them."""
    nominal = mean_score(run, agent_of(run).training.plant.model_dump(), {}, NOMINAL_STARTS)
    scores = emulated_scores(run, truths, draw["starts"], jobs)
    return {
        "run": str(run),
        **draw,
        "nominal": nominal,
        "carts": [cart_figures(truth, row, nominal) for truth, row in zip(truths, scores, strict=True)],
    }


def cart_figures(truth: Truth, scores: NDArray[np.float64], nominal: float) -> dict[str, Any]:
    """Return the figures of one cart; the ratios are None if no episode could be driven."""
    driven = scores[np.isfinite(scores)]
    return {
        "truth": truth,
        "scores": [float(each) if np.isfinite(each) else None for each in scores],
        "mean_ratio": float(driven.mean()) / nominal if len(driven) else None,
        "worst_ratio": float(driven.min()) / nominal if len(driven) else None,
        "lost": int((driven < LOST_SCORE).sum()),
        "not_driven": len(scores) - len(driven),
    }


def cart_row(number: int, cart: dict[str, Any]) -> dict[str, Cell]:
    """Return the table row of one cart."""
    truth = cart["truth"]
    return {
        "cart": number,
        "viscous": truth["cart_viscous"],
        "coulomb": (truth["cart_coulomb_left"] + truth["cart_coulomb_right"]) / 2,
        "mean ratio": cart["mean_ratio"],
        "worst ratio": cart["worst_ratio"],
        "lost": cart["lost"],
        "not driven": cart["not_driven"],
    }


def agent_row(result: dict[str, Any]) -> dict[str, Cell]:
    """Return the table row of one agent; its ratios are those of the carts that could be driven."""
    carts = result["carts"]
    means = [cart["mean_ratio"] for cart in carts if cart["mean_ratio"] is not None]
    worst = [cart["worst_ratio"] for cart in carts if cart["worst_ratio"] is not None]
    return {
        "run": result["run"],
        "nominal": f"{result['nominal']:.0f}",
        "mean ratio": float(np.mean(means)) if means else None,
        "worst cart": min(means, default=None),
        "worst start": min(worst, default=None),
        "lost": sum(cart["lost"] for cart in carts),
        "not driven": sum(cart["not_driven"] for cart in carts),
        "episodes": sum(len(cart["scores"]) for cart in carts),
    }


def earlier_results(file: Path | None, draw: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the results in the JSON file; exit if they are of other carts or starts."""
    if file is None or not file.exists():
        return []
    results = read_json(file)
    for result in results:
        if others := [f"--{key} {result.get(key)}" for key in draw if result.get(key) != draw[key]]:
            raise SystemExit(f"{file} was made with {', '.join(others)}: use that, or another --json file")
    return results


def share(text: str) -> float:
    """Convert `--wider` to a number from 0 to 1; beyond 1 some carts would have no mass."""
    if not 0 <= (value := float(text)) <= 1:
        raise argparse.ArgumentTypeError(f"{text} is not a share from 0 to 1")
    return value


def parse_options() -> argparse.Namespace:
    """Return the command-line options."""
    parser = option_parser(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of cartpole-train")
    parser.add_argument(
        "--truths", type=positive_int, default=20, help="number of carts, the same for every agent (20)"
    )
    parser.add_argument(
        "--starts", type=positive_int, default=1, help="episodes on each cart, each from another start (1)"
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=REPORTED,
        help=f"decides which carts are drawn: {REPORTED} (default) for reports; {COMPARED} gives the carts "
        "on which settings were compared",
    )
    parser.add_argument(
        "--wider",
        type=share,
        default=0.0,
        metavar="SHARE",
        help="extend each range on both sides by this share of its width, from 0 (default) to 1",
    )
    parser.add_argument("--jobs", type=positive_int, default=1, help="carts driven at the same time (1)")
    return parser.parse_args()


def main() -> None:
    """Judge each agent, print the tables and write the figures."""
    options = parse_options()
    use_threads(1)
    draw = {name: getattr(options, name) for name in DRAW}
    truths = draw_truths(options.seed, options.truths, options.wider)
    results = earlier_results(options.json, draw)
    for run in options.runs:
        if str(run) in [result["run"] for result in results]:
            continue
        results.append(judge(run, draw, truths, options.jobs))
        write_json(options.json, results)
        print(run)
        print_table([cart_row(number, cart) for number, cart in enumerate(results[-1]["carts"])])
        print()
    print_table([agent_row(result) for result in results])


if __name__ == "__main__":
    main()
