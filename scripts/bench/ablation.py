#!/usr/bin/env python
"""What each of the means of docs/learning.md is worth: the medium pole, trained without one at a time.

    scripts/bench/ablation.py --seeds 5 --jobs 2 --json ablation.json

Trainings are half as long as `cartpole-train experiment=medium`, so that a difference shows; all schedules
shrink with them. Runs go to runs/bench/ablation/<arm>/<seed> and are not trained again when they are there.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from learning import REFERENCES, result, train_all

from cartpole_rl.reporting.table import table
from cartpole_rl.workflows.build import use_threads

TRANSITIONS = 2_500_000
ARMS = {
    "as it is": [],
    "without mirror": ["agent.mirrored=false"],
    "without layer normalization": ["agent.layer_norm=false"],
    "without action gap": ["agent.action_gap=0"],
    "without averaged policy": ["agent.average_decay=null"],
    "single instead of double": ["agent.double=false"],
    "one-step returns": ["learning.n_step=1"],
    "returns of five whole steps": ["learning.carry=true"],
    "no resting starts": ["task.start.resting_share=0"],
    "constant learning rate": ["optimizer.learning_rate_end=1"],
    "prioritized replay": ["buffer=prioritized"],
    "no second tries": ["learning.retry_probability=0"],
    "rewards twice as large": ["reward.scale=0.1", "reward.track_penalty=10"],
    "without randomization": ["randomization=none"],
}


def main() -> None:
    """Train, judge, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=list(ARMS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once; 1 where time is measured")
    parser.add_argument("--json", type=Path, help="file for all figures")
    given = parser.parse_args()
    use_threads(1)
    references = {plant: found["score"] for plant, found in json.loads(REFERENCES.read_text()).items()}
    everything, rows = {}, []
    for arm in given.arms:
        words = [f"learning.transitions={TRANSITIONS}", *ARMS[arm]]
        parent = Path("runs/bench/ablation", arm.replace(" ", "_"))
        folders = train_all("medium", given.seeds, given.jobs, words, parent)
        results = [result("medium", folder, references) for folder in folders]
        everything[arm] = results
        fractions = [each["plants"]["medium"]["fraction"] for each in results]
        drawn = [each["plants"]["medium"]["drawn"] for each in results]
        failed = [each["plants"]["medium"]["failed"] for each in results]
        reached = [each["transitions_to_reached"] or float("inf") for each in results]
        rows.append(
            {
                "arm": arm,
                "min": f"{min(fractions):.3f}",
                "median": f"{np.median(fractions):.3f}",
                "max": f"{max(fractions):.3f}",
                "drawn carts": f"{np.median(drawn):.0f}",
                "failed": f"{100 * np.mean(failed):.1f} %",
                "million transitions to 0.9": f"{np.median(reached) / 1e6:.2f}",
                "kept over 0.85": f"{np.mean([each['kept'] or 0.0 for each in results]):.2f}",
            }
        )
        print(table(rows, {key: key for key in rows[0]}), flush=True)
    if given.json:
        given.json.write_text(json.dumps(everything, indent=1))


if __name__ == "__main__":
    main()
