#!/usr/bin/env python
"""Fine-tuning on carts that an agent was not trained for: the table of docs/fine-tuning.md.

    scripts/bench/fine_tuning.py runs/bench/medium/0 runs/bench/medium/1 runs/bench/medium/2 --json tuned.json

Each agent is fine-tuned on each cart of CARTS by `cartpole-finetune plant=emulated`, with as many episodes
before and after as that command says. Wanted is the lower of 1.15 times the score before and 0.95 times the
agent's score on the simulated nominal cart, and never less than before.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.reporting.table import table

USUAL = EmulatorSettings()
CARTS = {  # each differs from the emulator's own cart in one thing
    "friction": [  # a quarter more Coulomb friction, and 15 % more of it to the left than to the right
        f"emulator.cart_coulomb_left={1.25 * 1.15 * USUAL.cart_coulomb_left:.4f}",
        f"emulator.cart_coulomb_right={1.25 * USUAL.cart_coulomb_right:.4f}",
    ],
    "force": [f"emulator.force_curve={[round(0.8 * number, 9) for number in USUAL.force_curve]}"],
    "latency": [f"emulator.latency={USUAL.latency + 0.02}"],
    "tilt": ["emulator.track_tilt=0.008727"],  # 0.5 degrees
    "large pole": ["emulator=large"],
}
GAIN, SHARE = 1.15, 0.95


def tune(agent: Path, cart: str, seed: int, overrides: list[str]) -> dict[str, float]:
    """Scores before and after, and in simulation; trained already if the folder is there."""
    folder = Path("runs/bench/fine_tuning", agent.parent.name, agent.name, cart.replace(" ", "_"))
    if not (folder / "comparison.json").exists():
        command = [Path(sys.executable).with_name("cartpole-finetune"), f"run={agent}", "plant=emulated"]
        done = subprocess.run(
            [*command, *CARTS[cart], *overrides, f"seed={seed}", f"hydra.run.dir={folder}"],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            sys.exit(f"{agent} on {cart}: {done.stderr.strip().splitlines()[-1]}")
    compared = json.loads((folder / "comparison.json").read_text())
    simulated = json.loads((agent / "metrics.json").read_text())["score"]["mean"]
    before, after = (compared[stage]["score"]["mean"] for stage in ("before", "after"))
    wanted = min(GAIN * before, SHARE * simulated)
    kept = max(before, after)
    return {"simulated": simulated, "before": before, "after": after, "wanted": wanted, "met": kept >= wanted}


def main() -> None:
    """Fine-tune every agent on every cart, print a table, write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agents", nargs="+", type=Path, help="run folders of trainings")
    parser.add_argument("--carts", nargs="+", choices=list(CARTS), default=list(CARTS))
    parser.add_argument("--jobs", type=int, default=1, help="fine-tunings at once")
    parser.add_argument("--json", type=Path, help="file for all figures")
    given, overrides = parser.parse_known_args()
    jobs = [(agent, cart, seed) for seed, agent in enumerate(given.agents) for cart in given.carts]
    with ThreadPoolExecutor(given.jobs) as pool:
        found = list(pool.map(lambda job: tune(*job, overrides), jobs))
    rows = [
        {
            "agent": str(agent),
            "cart": cart,
            **{key: f"{figures[key]:.0f}" for key in ("simulated", "before", "after", "wanted")},
            "met": "yes" if figures["met"] else "no",
        }
        for (agent, cart, _), figures in zip(jobs, found, strict=True)
    ]
    print(table(rows, {key: key for key in rows[0]}))
    if given.json:
        named = [
            {"agent": str(agent), "cart": cart, **figures}
            for (agent, cart, _), figures in zip(jobs, found, strict=True)
        ]
        given.json.write_text(json.dumps(named, indent=1))


if __name__ == "__main__":
    main()
