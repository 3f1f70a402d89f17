#!/usr/bin/env python
"""Knocks: the pole is struck while it stands, falls, and has to come up again.

    scripts/bench/knocks.py runs/train/a runs/train/b --knocks 100 --json knocks.json

On nominal simulated carts the agent swings the pole up from hanging; 5 s in, each pole that stands gets an
angular speed drawn uniformly from +-(6 to 10) rad/s, enough to carry it past the horizontal. It is back up
when |theta| < 5 degrees from then on for a second.
"""

import argparse
import json
import math
from pathlib import Path

import torch

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.reporting.table import table
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.workflows.agents import TrainedAgent, trained_agent
from cartpole_rl.workflows.build import use_threads

STRUCK_AT, PATIENCE, HOLD = 250, 150, 50  # periods of 0.02 s: 5 s, 3 s, 1 s
SPEEDS = (6.0, 10.0)  # rad/s
UPRIGHT, FALLEN = math.radians(5), math.radians(90)


@torch.no_grad()
def recoveries(agent: TrainedAgent, knocks: int, seed: int) -> dict[str, float]:
    """How many stood before the knock, fell after it, stayed on the track, and were back within 3 s."""
    settings = agent.training.model_copy(update={"randomization": {}})
    env = simulated_env(
        settings, settings.plant, knocks, settings.task.evaluation_start, evaluation_seed(seed)
    )
    generator = torch.Generator().manual_seed(seed)
    low, high = SPEEDS
    sign = torch.randint(2, (knocks,), generator=generator) * 2 - 1
    knock = sign * (low + (high - low) * torch.rand(knocks, generator=generator))
    present = env.reset()
    angles, left = [], torch.zeros(knocks, dtype=torch.bool)
    for period in range(STRUCK_AT + PATIENCE + HOLD):
        if period == STRUCK_AT:
            state = env.plant.true_state
            env.plant.place(state._replace(theta_dot=state.theta_dot + knock))
        present["action"] = agent.policy(present.select("observation"))["action"]
        following = env.step(present)["next"]
        angles.append(following["state"][:, 2].abs())
        left |= following["terminated"].squeeze(-1)
        present = following.exclude("reward")
    angle = torch.stack(angles)  # [T, N]
    stood = (angle[STRUCK_AT - HOLD : STRUCK_AT] < UPRIGHT).all(0) & ~left
    after = angle[STRUCK_AT:]
    fell = (after[:PATIENCE] > FALLEN).any(0)
    held = torch.stack([(after[start : start + HOLD] < UPRIGHT).all(0) for start in range(PATIENCE + 1)])
    first_fall = (after > FALLEN).float().argmax(0)  # [N]
    later = torch.arange(PATIENCE + 1).unsqueeze(1) > first_fall
    back = (held & later).any(0) & fell & ~left
    return {
        "stood": int(stood.sum()),
        "fell": int((stood & fell).sum()),
        "back": int((stood & back).sum()),
        "left_track": int(left.sum()),
    }


def main() -> None:
    """Knock each run's last agent, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of cartpole-train")
    parser.add_argument("--knocks", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file for all figures")
    given = parser.parse_args()
    use_threads(1)
    results = [
        {"run": str(run), **recoveries(trained_agent(run), given.knocks, given.seed)} for run in given.runs
    ]
    print(table(results, {key: key.replace("_", " ") for key in results[0]}))
    if given.json:
        given.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
