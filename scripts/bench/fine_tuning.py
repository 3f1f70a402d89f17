#!/usr/bin/env python
"""Does fine-tuning help on carts for which an agent was not trained? Table: docs/results/fine-tuning.md.

    scripts/bench/fine_tuning.py runs/bench/medium/0 runs/bench/medium/1 runs/bench/medium/2 --json tuned.json

Fine-tunes each agent on each cart with `cartpole-finetune plant=emulated`; further words are passed on as
overrides. The target is the lower of 1.15 times the score before and 0.95 times the agent's score on the
simulated nominal cart. The runs are in runs/bench/fine_tuning; one that exists is not made again.
"""

from pathlib import Path

from common import RUNS, in_parallel, mean_score, option_parser, print_table, read_json, run_once, write_json

from cartpole_rl.emulator.settings import EmulatorSettings

DEFAULT = EmulatorSettings()
CARTS = {  # each differs from the emulator's default in one property
    "friction": [  # a quarter more Coulomb friction, and another 15 % to the left
        f"emulator.cart_coulomb_left={1.25 * 1.15 * DEFAULT.cart_coulomb_left:.4f}",
        f"emulator.cart_coulomb_right={1.25 * DEFAULT.cart_coulomb_right:.4f}",
    ],
    "force": [f"emulator.force_curve={[round(0.8 * number, 9) for number in DEFAULT.force_curve]}"],
    "latency": [f"emulator.latency={DEFAULT.latency + 0.02}"],
    "tilt": ["emulator.track_tilt=0.008727"],  # 0.5 degrees
    "large pole": ["emulator=large"],
}
GAIN, SHARE = 1.15, 0.95


def tune(agent: Path, cart: str, seed: int, overrides: list[str]) -> dict[str, float]:
    """Return the scores in simulation, before and after, and whether the kept policy meets the target."""
    folder = RUNS / "fine_tuning" / agent.parent.name / agent.name / cart.replace(" ", "_")
    words = [f"run={agent}", "plant=emulated", *CARTS[cart], *overrides, f"seed={seed}"]
    run_once(folder, "finetune", *words, result="comparison.json")
    compared = read_json(folder / "comparison.json")
    simulated = mean_score(agent / "metrics.json")
    before, after = (compared[stage]["score"]["mean"] for stage in ("before", "after"))
    target = min(GAIN * before, SHARE * simulated)
    met = max(before, after) >= target
    return {"simulated": simulated, "before": before, "after": after, "target": target, "met": met}


def main() -> None:
    """Fine-tune every agent on every cart, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("agents", nargs="+", type=Path, help="run folders of cartpole-train")
    parser.add_argument("--carts", nargs="+", choices=list(CARTS), default=list(CARTS))
    parser.add_argument("--jobs", type=int, default=1, help="fine-tunings at the same time (1)")
    options, overrides = parser.parse_known_args()
    jobs = [(agent, cart, seed) for seed, agent in enumerate(options.agents) for cart in options.carts]
    tuned = in_parallel(lambda job: tune(*job, overrides), jobs, options.jobs)
    results = [
        {"agent": str(agent), "cart": cart, **figures}
        for (agent, cart, _), figures in zip(jobs, tuned, strict=True)
    ]
    scores = ("simulated", "before", "after", "target")
    print_table([{**result, **{key: f"{result[key]:.0f}" for key in scores}} for result in results])
    write_json(options.json, results)


if __name__ == "__main__":
    main()
