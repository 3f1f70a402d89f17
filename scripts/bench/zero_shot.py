#!/usr/bin/env python
"""One agent on carts it never saw: last checkpoints on emulated carts whose truths are drawn at random.

    scripts/bench/zero_shot.py runs/train/a runs/train/b --truths 20 --json zero_shot.json

Each cart is a process of its own with MuJoCo physics, driven over its serial port. The score of each truth is
divided by the same agent's on the nominal simulated cart (mean of 20 starts).
"""

import argparse
import json
import math
from contextlib import closing
from pathlib import Path

import numpy as np

from cartpole_rl.commands.build import (
    TrainedAgent,
    evaluated_env,
    evaluated_settings,
    trained_agent,
    use_threads,
)
from cartpole_rl.commands.config import EvaluateConfig, checked
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.reporting.table import table

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
SIDES = 0.15  # share by which the Coulomb friction of each side differs from the mean


def draw_truth(random: np.random.Generator) -> dict[str, float]:
    """`emulator.*` of one cart."""
    truth = {name: float(random.uniform(*bounds)) for name, bounds in UNIFORM.items()}
    truth |= {name: float(np.exp(random.uniform(*np.log(bounds)))) for name, bounds in LOG_UNIFORM.items()}
    coulomb, side = truth.pop("cart_coulomb"), random.uniform(-SIDES, SIDES)
    return truth | {"cart_coulomb_left": coulomb * (1 - side), "cart_coulomb_right": coulomb * (1 + side)}


def score(agent: TrainedAgent, run: Path, plant: dict, truth: dict[str, float], episodes: int) -> float:
    """Mean score of the agent's last checkpoint."""
    given = {
        "run": run,
        "episodes": episodes,
        "plant": plant,
        "emulator": EmulatorSettings(**truth),
        "randomization": {},
        "parameters": None,
        "seed": 1,
        "label": "",
        "threads": 1,
    }
    config = checked(EvaluateConfig, given)
    with closing(evaluated_env(evaluated_settings(agent.training, config), config, print)) as env:
        return float(np.mean([each.score.sum() for each in run_episodes(env, agent.policy, episodes)]))


def main() -> None:
    """Judge each run, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of cartpole-train")
    parser.add_argument("--truths", type=int, default=20, help="carts drawn, the same for each run")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--json", type=Path, help="file for all figures")
    given = parser.parse_args()
    use_threads(1)
    random = np.random.default_rng(given.seed)
    truths = [draw_truth(random) for _ in range(given.truths)]
    rows, results = [], []
    for run in given.runs:
        agent = trained_agent(run)
        nominal = score(agent, run, agent.training.plant.model_dump(), {}, 20)
        scores = [score(agent, run, {"kind": "emulated"}, truth, 1) for truth in truths]
        ratios = np.array(scores) / nominal
        results.append({"run": str(run), "nominal": nominal, "truths": truths, "scores": scores})
        rows.append(
            {
                "run": str(run),
                "nominal": f"{nominal:.0f}",
                "mean": f"{ratios.mean():.3f}",
                "worst": f"{ratios.min():.3f}",
            }
        )
        print(rows[-1], [round(each) for each in scores], flush=True)
    print(table(rows, {"run": "run", "nominal": "nominal", "mean": "mean ratio", "worst": "worst ratio"}))
    if given.json:
        given.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
