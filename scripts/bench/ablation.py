#!/usr/bin/env python
"""How much does each technique of docs/learning.md contribute? Trains the medium pole without one at a time.

    scripts/bench/ablation.py --seeds 5 --jobs 2 --json ablation.json

Trainings are half as long as `cartpole-train experiment=medium`, so that differences show; all schedules
shrink with them. The runs are in runs/bench/ablation/<arm>/<seed>; one that exists is not trained again.
The figures are those of scripts/bench/learning.py.
"""

from typing import Any

import numpy as np
from common import (
    RUNS,
    add_seed_options,
    chosen_seeds,
    min_median_max,
    option_parser,
    print_table,
    reference_scores,
    train_seeds,
    write_json,
)
from learning import seed_result

from cartpole_rl.workflows.build import use_threads

TRANSITIONS = 2_000_000
ARMS = {  # name: overrides of cartpole-train
    "default": [],
    "without mirror": ["agent.mirrored=false"],
    "without layer normalization": ["agent.layer_norm=false"],
    "without action gap": ["agent.action_gap=0"],
    "without averaged policy": ["agent.average_decay=null"],
    "single instead of double": ["agent.double=false"],
    "one-step returns": ["learning.n_step=1"],
    "returns end with their chunk": ["learning.carry=false"],
    "no resting starts": ["task.start.resting_share=0"],
    "constant learning rate": ["optimizer.learning_rate_end=1"],
    "uniform replay": ["buffer=uniform"],
    "no retries": ["learning.retry_probability=0"],
    "rewards twice as large": ["reward.scale=0.1", "reward.track_penalty=10"],
    "without randomization": ["randomization=none"],
    "no track guard": ["guard=none"],
    "bold track guard": ["guard=bold"],
    "careful track guard": ["guard=careful"],
    "slow starts": ["task.start.speed_spread=0.2", "task.start.angular_speed_spread=1"],
    "two layers of 128": ["agent.hidden=[128,128]"],
    "two layers of 64": ["agent.hidden=[64,64]"],
}


def row(arm: str, results: list[dict[str, Any]]) -> dict[str, str]:
    """Return the table row of one arm."""
    judged = [each["plants"]["medium"] for each in results]
    reached = [each["transitions_to_reached"] or float("inf") for each in results]
    return {
        "arm": arm,
        **min_median_max([each["fraction"] for each in judged], decimals=3),
        "drawn carts": f"{np.median([each['drawn'] for each in judged]):.0f}",
        "failed": f"{100 * np.mean([each['failed'] for each in judged]):.1f} %",
        "million transitions to 0.9": f"{np.median(reached) / 1e6:.2f}",
        "kept over 0.85": f"{np.mean([each['kept'] or 0.0 for each in results]):.2f}",
    }


def main() -> None:
    """Train, judge, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=list(ARMS), metavar="ARM")
    add_seed_options(parser, seeds=5)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at the same time (1)")
    options = parser.parse_args()
    use_threads(1)
    references = reference_scores()
    everything, rows = {}, []
    for arm in options.arms:
        words = [f"learning.transitions={TRANSITIONS}", *ARMS[arm]]
        parent = RUNS / "ablation" / arm.replace(" ", "_")
        folders = train_seeds("medium", chosen_seeds(options), options.jobs, words, parent)
        everything[arm] = [seed_result("medium", folder, references) for folder in folders]
        rows.append(row(arm, everything[arm]))
        print_table(rows)
    write_json(options.json, everything)


if __name__ == "__main__":
    main()
