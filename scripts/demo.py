"""The demo after its installation: train, evaluate on both plants, compare. See scripts/demo."""

import json
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path

import numpy as np

from cartpole_rl.reporting.figures import comparison, save
from cartpole_rl.reporting.scores import SCORES
from cartpole_rl.reporting.table import interval_text, table

EPISODES = 10
BIN = Path(sys.executable).parent
SHOWN = ("score", "score_upright", "time_to_upright_s", "upright_fraction", "min_track_margin_m")


def main() -> None:
    """Train, evaluate, and print a comparison."""
    started = time.perf_counter()
    folder = Path("runs/demo") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    step("1/3: train an agent in simulation")
    run("train", f"hydra.run.dir={folder}/train", "experiment=medium", *sys.argv[1:])
    step("2/3: evaluate it in simulation")
    simulated = evaluate(folder, "simulated")
    step("3/3: evaluate it on an emulated cart, over a serial port")
    emulated = evaluate(folder, "emulated")
    report(folder, {"simulated": simulated, "emulated": emulated})
    print(f"The demo took {time.perf_counter() - started:.0f} s. Its results are in {folder}.")
    print(f"Next, fine-tune the agent: .venv/bin/cartpole-finetune run={folder}/train plant=emulated")


def step(title: str) -> None:
    """Print the title of a step."""
    print(f"\n== {title}", flush=True)


def run(name: str, *arguments: str) -> None:
    """Run cartpole-`name`; exit with its status if it fails."""
    print(f"$ cartpole-{name} {' '.join(arguments)}", flush=True)
    status = subprocess.run([BIN / f"cartpole-{name}", *arguments], check=False).returncode
    if status:
        sys.exit(status)


def evaluate(folder: Path, plant: str) -> dict:
    """Return the metrics of the last checkpoint on `plant`."""
    output = folder / plant
    run(
        "evaluate", f"hydra.run.dir={output}", f"run={folder}/train", f"plant={plant}", f"episodes={EPISODES}"
    )
    return json.loads((output / "metrics.json").read_text())


def report(folder: Path, results: dict[str, dict]) -> None:
    """Print the results by plant, save the comparison figure and list all figures."""
    print(f"\nThe last checkpoint on both carts: mean and 95 % interval of {EPISODES} episodes")
    rows = [
        {"figure": SCORES[key]} | {plant: mean_text(result[key]) for plant, result in results.items()}
        for key in SHOWN
    ]
    print(table(rows, {"figure": "", "simulated": "simulated", "emulated": "emulated"}))
    ratio = results["emulated"]["score"]["mean"] / results["simulated"]["score"]["mean"]
    print(f"ratio of the scores, emulated / simulated: {ratio:.2f}\n")
    scores = {name: np.array([e["score"] for e in result["episodes"]]) for name, result in results.items()}
    intervals = {name: (result["score"]["low"], result["score"]["high"]) for name, result in results.items()}
    save(comparison(scores, "The same agent on two carts", intervals), folder / "comparison.png")
    print(f"scores:          {folder}/comparison.png")
    print(f"learning curve:  {folder}/train/figures/learning_curve.png")
    print(f"TensorBoard:     .venv/bin/tensorboard --logdir {folder}")


def mean_text(figure: dict | None) -> str:
    """Return a mean with its interval; "never" if no episode has the figure."""
    return "never" if figure is None else interval_text(figure["mean"], figure["low"], figure["high"])


if __name__ == "__main__":
    main()
