#!/usr/bin/env python
"""Do agents that were trained on an identified cart drive it better than others?

    scripts/bench/identified_agents.py --truths 5 --seeds 3 --json agents.json

Compares agents trained on the cart as identified, on the nominal cart, and with wide randomization. Needs
the runs of scripts/bench/identification.py. The last checkpoint of each agent drives each emulated cart for
ten episodes. `real / simulated` is that score divided by the agent's score on the simulated cart for which
it was trained. Further words are passed to cartpole-train as overrides. The runs are in
runs/bench/identified_agents; one that exists is not made again.
"""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from common import RUNS, in_parallel, mean_score, option_parser, print_table, read_json, run_once, write_json
from truths import overrides

IDENTIFIED, AGENTS = RUNS / "identify", RUNS / "identified_agents"
EPISODES = 10
KINDS = ("identified", "nominal", "wide")


def train(kind: str, number: int, seed: int, words: list[str]) -> Path:
    """Return the run folder of one agent; only the kind `identified` depends on the cart."""
    folder = AGENTS / (f"{kind}_{number:02d}_{seed}" if kind == "identified" else f"{kind}_{seed}")
    extra: dict[str, list[str]] = {"nominal": ["randomization=none"], "wide": []}
    if kind == "identified":
        extra[kind] = identified_choices(number)
    return run_once(folder, "train", "experiment=medium", *extra[kind], *words, f"seed={seed}")


def identified_choices(number: int) -> list[str]:
    """Return the overrides that train on the cart that cartpole-identify wrote."""
    run = IDENTIFIED / f"{number:02d}"
    friction = read_json(run / "identification.json")["cart_friction"]
    files = [f"{group}={run}/{group}.yaml" for group in ("cart", "pole", "randomization")]
    return [*files, f"cart_friction={friction}", "pole_friction=bearing"]


def emulated_score(agent: Path, number: int) -> float:
    """Return the mean score on an emulated cart."""
    folder = AGENTS / "driven" / f"{agent.name}_on_{number:02d}"
    truth = yaml.safe_load((IDENTIFIED / f"{number:02d}" / "truth.yaml").read_text())
    words = [f"run={agent}", "plant=emulated", f"episodes={EPISODES}", *overrides(truth)]
    return mean_score(run_once(folder, "evaluate", *words) / "metrics.json")


def judge(kind: str, number: int, seed: int, words: list[str]) -> dict[str, Any]:
    """Train one agent and drive one cart; return its scores."""
    agent = train(kind, number, seed, words)
    real, simulated = emulated_score(agent, number), mean_score(agent / "metrics.json")
    result = {"cart": number, "agent": kind, "seed": seed, "real": real, "simulated": simulated}
    print(result, flush=True)
    return result


def row(cart: str, kind: str, results: list[dict[str, Any]]) -> dict[str, str]:
    """Return the table row of one kind of agent on one cart, or on all carts."""
    real = np.array([each["real"] for each in results])
    ratio = real / np.array([each["simulated"] for each in results])
    return {
        "cart": cart,
        "agent": kind,
        "real: min": f"{real.min():.0f}",
        "mean": f"{real.mean():.0f}",
        "max": f"{real.max():.0f}",
        "real / simulated": f"{ratio.mean():.3f}",
    }


def main() -> None:
    """Train, drive, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("--truths", type=int, default=5, help="number of carts (5)")
    parser.add_argument("--seeds", type=int, default=3, help="agents of each kind (3)")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at the same time (1)")
    options, words = parser.parse_known_args()
    carts = range(options.truths)
    jobs = [(kind, number, seed) for number in carts for kind in KINDS for seed in range(options.seeds)]
    results = in_parallel(lambda job: judge(*job, words), jobs, options.jobs)
    rows = []
    for cart in [*carts, "all"]:
        for kind in KINDS:
            chosen = [each for each in results if each["agent"] == kind and cart in (each["cart"], "all")]
            rows.append(row(str(cart), kind, chosen))
    print_table(rows)
    write_json(options.json, results)


if __name__ == "__main__":
    main()
