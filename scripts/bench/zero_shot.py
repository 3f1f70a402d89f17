#!/usr/bin/env python
"""One agent on carts it never saw: last checkpoints on emulated carts whose truths are drawn at random.

    scripts/bench/zero_shot.py runs/train/a runs/train/b --truths 20 --starts 5 --jobs 2 --json zero_shot.json
    scripts/bench/zero_shot.py runs/train/a runs/train/b --wider 0.333 --json wider.json

Each cart is a process of its own with MuJoCo physics, driven over its serial port. Its score is divided by
the same agent's on the nominal simulated cart (mean of 20 starts). An episode that scores less than 500 is
lost. One that cannot be driven (homing fails) is counted apart and has no score.

The drawn numbers lie inside the ranges of `randomization=wide`, which agents learn from; the stiction ratio
alone is not trained on. `--wider` draws from wider ranges, so that most carts have numbers outside of those.
Settings were compared on the carts of `--seed 0`, so figures of these carts are biased; report other draws.

A run folder's figures are in the JSON file as soon as it has been driven. With a file that is there already,
the run folders in it are not driven again.
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
from numpy.typing import NDArray

from cartpole_rl.checking import checked
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import PlantError
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.reporting.table import Cell, table
from cartpole_rl.workflows.agents import TrainedAgent, trained_agent
from cartpole_rl.workflows.build import evaluated_env, evaluated_settings, use_threads
from cartpole_rl.workflows.config import EvaluateConfig

COMPARED, REPORTED = 0, 1000  # seeds: of the carts that settings were compared on, and of those to report
NOMINAL_CART_MASS = 0.703  # kg, as conf/cart/ip02.yaml
UNIFORM = {  # of the truth; the rest is what the emulator has by default
    "cart_mass": (0.8 * NOMINAL_CART_MASS, 1.2 * NOMINAL_CART_MASS),
    "cart_stiction_ratio": (1.0, 1.6),
    "force_asymmetry": (-0.12, 0.12),
    "motor_time_constant": (0.0, 0.02),
    "latency": (0.0, 0.02),
    "track_tilt": (-math.radians(0.45), math.radians(0.45)),
    "angle_offset": (-math.radians(0.85), math.radians(0.85)),
}
LOG_UNIFORM = {"cart_viscous": (0.3, 3.0), "pole_viscous": (1e-4, 1e-3), "cart_coulomb": (0.25, 0.9)}
SIDES = (-0.15, 0.15)  # share by which the Coulomb friction of each side differs from the mean
SMALLEST = {"cart_stiction_ratio": 1.0, "motor_time_constant": 0.0, "latency": 0.0}  # that are possible
LOST = 500  # an episode that scores less

Truth = dict[str, float]  # `emulator.*` of one cart


def widened(bounds: tuple[float, float], share: float, smallest: float = -math.inf) -> tuple[float, float]:
    """`bounds` moved apart by `share` of their distance on each side, the lower one down to `smallest`."""
    low, high = bounds
    more = share * (high - low)
    return max(low - more, smallest), high + more


def ranges(wider: float = 0.0) -> dict[str, tuple[float, float]]:
    """What each number is drawn between, with every range widened; a log-uniform one as a logarithm."""
    uniform = {name: widened(each, wider, SMALLEST.get(name, -math.inf)) for name, each in UNIFORM.items()}
    log_uniform = {
        name: widened((float(np.log(low)), float(np.log(high))), wider)
        for name, (low, high) in LOG_UNIFORM.items()
    }
    return {**uniform, **log_uniform, "sides": widened(SIDES, wider)}


def draw_truth(random: np.random.Generator, wider: float = 0.0) -> Truth:
    """One cart, from ranges that are wider by the share `wider` of their width on each side."""
    truth = {name: float(random.uniform(*bounds)) for name, bounds in ranges(wider).items()}
    truth |= {name: float(np.exp(truth[name])) for name in LOG_UNIFORM}
    coulomb, side = truth.pop("cart_coulomb"), truth.pop("sides")
    return truth | {"cart_coulomb_left": coulomb * (1 - side), "cart_coulomb_right": coulomb * (1 + side)}


def draw_truths(seed: int, count: int, wider: float = 0.0) -> list[Truth]:
    """`count` carts; the first ones of a larger count are the same."""
    random = np.random.default_rng(seed)
    return [draw_truth(random, wider) for _ in range(count)]


@cache
def agent_of(run: Path) -> TrainedAgent:
    """The agent of a run folder's last checkpoint."""
    return trained_agent(run)


def score(run: Path, plant: dict[str, Any], truth: Truth, episodes: int, seed: int = 1) -> float:
    """Mean score of the agent's last checkpoint."""
    given = {
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
    config, agent = checked(EvaluateConfig, given), agent_of(run)
    with closing(evaluated_env(evaluated_settings(agent.training, config), config, print)) as env:
        return float(np.mean([each.score.sum() for each in run_episodes(env, agent.policy, episodes)]))


def emulated_score(run: Path, job: tuple[Truth, int]) -> float:
    """Score of one episode on an emulated cart, NaN where it cannot be driven; its seed decides its start."""
    truth, seed = job
    try:
        return score(run, {"kind": "emulated"}, truth, 1, seed)
    except PlantError as error:  # with much friction a cart does not find its stops
        print(f"not driven, start {seed}: {error}; {json.dumps(truth)}", flush=True)
        return math.nan


def driven(run: Path, truths: Sequence[Truth], starts: int, jobs: int) -> NDArray[np.float64]:
    """Scores [truths, starts], `jobs` carts driven at once; NaN for an episode that could not be driven."""
    work = [(truth, 1 + start) for truth in truths for start in range(starts)]
    drive = partial(emulated_score, run)
    if jobs == 1:
        return np.reshape(list(map(drive, work)), (len(truths), starts))
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawn, initializer=use_threads, initargs=(1,)) as pool:
        return np.reshape(list(pool.map(drive, work)), (len(truths), starts))


def judged(run: Path, draw: dict[str, Any], truths: list[Truth], jobs: int) -> dict[str, Any]:
    """All figures of a run folder, as they stand in the JSON file."""
    nominal = score(run, agent_of(run).training.plant.model_dump(), {}, 20)
    scores = driven(run, truths, draw["starts"], jobs)
    return {
        "run": str(run),
        **draw,
        "nominal": nominal,
        "carts": [cart_figures(truth, row, nominal) for truth, row in zip(truths, scores, strict=True)],
    }


def cart_figures(truth: Truth, scores: NDArray[np.float64], nominal: float) -> dict[str, Any]:
    """Figures of one cart; its ratios are None where it could not be driven at all."""
    present = scores[np.isfinite(scores)]
    return {
        "truth": truth,
        "scores": [float(each) if np.isfinite(each) else None for each in scores],
        "mean_ratio": float(present.mean()) / nominal if len(present) else None,
        "worst_ratio": float(present.min()) / nominal if len(present) else None,
        "lost": int((present < LOST).sum()),
        "not_driven": len(scores) - len(present),
    }


def cart_row(number: int, cart: dict[str, Any]) -> dict[str, Cell]:
    """Table line of one cart."""
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


def run_row(result: dict[str, Any]) -> dict[str, Cell]:
    """Table line of a run folder; ratios are of the carts that could be driven."""
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


def known(file: Path | None, draw: dict[str, Any]) -> list[dict[str, Any]]:
    """What the JSON file holds already. Exits where it is of other carts."""
    if file is None or not file.exists():
        return []
    results = json.loads(file.read_text())
    for result in results:
        if others := [f"--{key} {result.get(key)}" for key in draw if result.get(key) != draw[key]]:
            raise SystemExit(f"{file} is of {', '.join(others)}: give the same, or another --json")
    return results


def share(word: str) -> float:
    """`--wider`: beyond 1 carts would have no mass."""
    if not 0 <= (value := float(word)) <= 1:
        raise argparse.ArgumentTypeError(f"{word} is not a share from 0 to 1")
    return value


def count(word: str) -> int:
    """A number of things, at least one."""
    if (value := int(word)) < 1:
        raise argparse.ArgumentTypeError(f"{word} is less than 1")
    return value


def arguments() -> argparse.Namespace:
    """What is given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of cartpole-train")
    parser.add_argument("--truths", type=count, default=20, help="carts drawn, the same for each run")
    parser.add_argument(
        "--starts", type=count, default=1, help="episodes on each cart, from different starts"
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=REPORTED,
        help=f"of the draw; {REPORTED}, the default, is for reports, {COMPARED} has the carts that settings "
        "were compared on",
    )
    parser.add_argument(
        "--wider",
        type=share,
        default=0.0,
        help="draw from ranges wider by this share of their width on both sides, beyond those of training",
    )
    parser.add_argument("--jobs", type=count, default=1, help="carts driven at once")
    parser.add_argument(
        "--json", type=Path, help="file for all figures; run folders in it are not driven again"
    )
    return parser.parse_args()


def main() -> None:
    """Judge each run, print a table, write what was seen."""
    given = arguments()
    use_threads(1)
    draw = {name: getattr(given, name) for name in ("truths", "starts", "seed", "wider")}
    truths = draw_truths(given.seed, given.truths, given.wider)
    results = known(given.json, draw)
    for run in given.runs:
        if str(run) in [result["run"] for result in results]:
            continue
        results.append(judged(run, draw, truths, given.jobs))
        rows = [cart_row(number, cart) for number, cart in enumerate(results[-1]["carts"])]
        print(f"{run}\n{table(rows, list(rows[0]))}\n", flush=True)
        if given.json:
            given.json.write_text(json.dumps(results, indent=1))
    rows = [run_row(result) for result in results]
    print(table(rows, list(rows[0])))


if __name__ == "__main__":
    main()
