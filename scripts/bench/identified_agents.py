#!/usr/bin/env python
"""Agents trained on carts as identified, on the nominal cart, and on wide randomization, driving those carts.

    scripts/bench/identified_agents.py --truths 5 --seeds 3 --json agents.json

Needs scripts/bench/identification.py before. The last checkpoint of each agent drives each emulated cart ten
times. The ratio is that score to the agent's own on the simulated cart it was trained for. Trainings go to
runs/bench/identified_agents/ and are not made again when they are there.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import yaml

from cartpole_rl.reporting.table import table

IDENTIFIED, AGENTS = Path("runs/bench/identify"), Path("runs/bench/identified_agents")
EPISODES = 10
KINDS = ("identified", "nominal", "wide")


def command(verb: str, *words: str) -> None:
    """Run a command; end with its complaint if it fails."""
    program = Path(sys.executable).with_name(f"cartpole-{verb}")
    done = subprocess.run([program, *words], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr.strip().splitlines()[-1])


def trained(kind: str, number: int, seed: int, words: list[str]) -> Path:
    """The run of one agent; those that know no truth are the same for each."""
    folder = AGENTS / (f"{kind}_{number:02d}_{seed}" if kind == "identified" else f"{kind}_{seed}")
    if not (folder / "metrics.json").exists():
        given = {"identified": on_identified(number), "nominal": ["randomization=none"], "wide": []}[kind]
        command("train", "experiment=medium", *given, *words, f"seed={seed}", f"hydra.run.dir={folder}")
    return folder


def on_identified(number: int) -> list[str]:
    """The choices that cartpole-identify wrote."""
    run = IDENTIFIED / f"{number:02d}"
    law = json.loads((run / "identification.json").read_text())["cart_friction"]
    files = [f"{group}={run}/{group}.yaml" for group in ("cart", "pole", "randomization")]
    return [*files, f"cart_friction={law}", "pole_friction=bearing"]


def driven(agent: Path, number: int) -> float:
    """Mean score on the emulated cart."""
    folder = AGENTS / "driven" / f"{agent.name}_on_{number:02d}"
    if not (folder / "metrics.json").exists():
        truth = yaml.safe_load((IDENTIFIED / f"{number:02d}" / "truth.yaml").read_text())
        words = [f"emulator.{name}={value}" for name, value in truth.items()]
        command(
            "evaluate",
            f"run={agent}",
            "plant=emulated",
            f"episodes={EPISODES}",
            *words,
            f"hydra.run.dir={folder}",
        )
    return score(folder)


def score(folder: Path) -> float:
    """Mean score of a run."""
    return float(json.loads((folder / "metrics.json").read_text())["score"]["mean"])


def main() -> None:
    """Train, drive, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1, help="trainings at once")
    parser.add_argument("--json", type=Path, help="file for all figures")
    given, words = parser.parse_known_args()
    asked = [
        (kind, number, seed)
        for number in range(given.truths)
        for kind in KINDS
        for seed in range(given.seeds)
    ]

    def judged(one: tuple[str, int, int]) -> dict[str, object]:
        kind, number, seed = one
        agent = trained(kind, number, seed, words)
        real, simulated = driven(agent, number), score(agent)
        found = {"cart": number, "agent": kind, "seed": seed, "real": real, "simulated": simulated}
        print(found, flush=True)
        return found

    with ThreadPoolExecutor(given.jobs) as pool:
        results = list(pool.map(judged, asked))
    rows = []
    for number in [*range(given.truths), "all"]:
        for kind in KINDS:
            those = [each for each in results if each["agent"] == kind and number in (each["cart"], "all")]
            real = np.array([each["real"] for each in those])
            ratio = real / np.array([each["simulated"] for each in those])
            rows.append(
                {
                    "cart": str(number),
                    "agent": kind,
                    "real: min": f"{real.min():.0f}",
                    "mean": f"{real.mean():.0f}",
                    "max": f"{real.max():.0f}",
                    "real / simulated": f"{ratio.mean():.3f}",
                }
            )
    print(table(rows, {key: key for key in rows[0]}))
    if given.json:
        given.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
