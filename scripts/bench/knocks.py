#!/usr/bin/env python
"""Does an agent bring the pole up again after it was knocked down?

    scripts/bench/knocks.py runs/train/a runs/train/b --knocks 100 --json knocks.json

On nominal simulated carts the agent swings the pole up from hanging. After 5 s each pole gets an additional
angular speed of 6 to 10 rad/s (uniform) to either side, enough to carry it past the horizontal. The pole is
back when |theta| stays below 5 degrees for a second, beginning within 3 s of the knock.
"""

import math
from pathlib import Path

import torch
from common import option_parser, print_table, write_json
from torch import Tensor

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.workflows.agents import TrainedAgent, trained_agent
from cartpole_rl.workflows.build import use_threads

KNOCK, PATIENCE, HOLD = 250, 150, 50  # periods of 0.02 s: 5 s, 3 s, 1 s
SPEEDS = (6.0, 10.0)  # rad/s
UPRIGHT, FALLEN = math.radians(5), math.radians(90)


def knocks(count: int, seed: int) -> Tensor:
    """Return angular speeds [count], rad/s."""
    generator = torch.Generator().manual_seed(seed)
    low, high = SPEEDS
    sign = torch.randint(2, (count,), generator=generator) * 2 - 1
    return sign * (low + (high - low) * torch.rand(count, generator=generator))


@torch.no_grad()
def knocked_episodes(agent: TrainedAgent, knock: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Return |theta| [T, N] and whether each cart left the track [N]."""
    settings = agent.training.model_copy(update={"randomization": {}})
    start = settings.task.evaluation_start
    env = simulated_env(settings, settings.plant, len(knock), start, evaluation_seed(seed))
    present = env.reset()
    angles, off_track = [], torch.zeros(len(knock), dtype=torch.bool)
    for period in range(KNOCK + PATIENCE + HOLD):
        if period == KNOCK:
            state = env.plant.true_state
            env.plant.place(state._replace(theta_dot=state.theta_dot + knock))
        present["action"] = agent.policy(present.select("observation"))["action"]
        following = env.step(present)["next"]
        angles.append(following["state"][:, 2].abs())
        off_track |= following["terminated"].squeeze(-1)
        present = following.exclude("reward")
    return torch.stack(angles), off_track


def recoveries(agent: TrainedAgent, count: int, seed: int) -> dict[str, int]:
    """Count the poles that stood before the knock, fell, and were back, and the carts that left the track."""
    angle, off_track = knocked_episodes(agent, knocks(count, seed), seed)
    stood = (angle[KNOCK - HOLD : KNOCK] < UPRIGHT).all(0) & ~off_track
    after = angle[KNOCK:]
    fell = (after[:PATIENCE] > FALLEN).any(0)
    held = torch.stack([(after[start : start + HOLD] < UPRIGHT).all(0) for start in range(PATIENCE + 1)])
    first_fall = (after > FALLEN).float().argmax(0)  # [N]
    later = torch.arange(PATIENCE + 1).unsqueeze(1) > first_fall
    back = (held & later).any(0) & fell & ~off_track
    return {
        "stood": int(stood.sum()),
        "fell": int((stood & fell).sum()),
        "back": int((stood & back).sum()),
        "left_track": int(off_track.sum()),
    }


def main() -> None:
    """Knock each agent's pole, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders of cartpole-train")
    parser.add_argument("--knocks", type=int, default=100, help="carts for each agent, one knock each (100)")
    parser.add_argument("--seed", type=int, default=0, help="of the starts and knocks (0)")
    options = parser.parse_args()
    use_threads(1)
    results = [
        {"run": str(run), **recoveries(trained_agent(run), options.knocks, options.seed)}
        for run in options.runs
    ]
    print_table(results)
    write_json(options.json, results)


if __name__ == "__main__":
    main()
