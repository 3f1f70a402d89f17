"""The demo's steps after installation: train, evaluate simulated and emulated, compare. See scripts/demo."""

import json
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path

import numpy as np

from cartpole_rl.reporting.figures import comparison, save
from cartpole_rl.reporting.table import interval_text, table

EPISODES = 10
BIN = Path(sys.executable).parent


def main() -> None:
    """Run the main job and print what came of it."""
    started = time.perf_counter()
    folder = Path("runs/demo") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    command("train", f"hydra.run.dir={folder}/train", "experiment=medium", *sys.argv[1:])
    results = {plant: evaluate(folder, plant) for plant in ("simulated", "emulated")}
    ratio = results["emulated"]["score"]["mean"] / results["simulated"]["score"]["mean"]
    show(results)
    scores = {name: np.array([e["score"] for e in result["episodes"]]) for name, result in results.items()}
    intervals = {name: (result["score"]["low"], result["score"]["high"]) for name, result in results.items()}
    save(comparison(scores, "The same agent on two carts", intervals), folder / "comparison.png")
    print(f"\nratio of the scores, emulated over simulated: {ratio:.2f}")
    print(f"figures: {folder}/comparison.png")
    print(f"         {folder}/*/figures/: learning_curve.png, behaviour.png, episode.gif")
    print(f"curves:  .venv/bin/tensorboard --logdir {folder}")
    print(f"the whole took {time.perf_counter() - started:.0f} s")


def command(name: str, *arguments: str) -> None:
    """Run a console script of this environment; stop where it fails."""
    print(f"\n$ cartpole-{name} {' '.join(arguments)}", flush=True)
    code = subprocess.run([BIN / f"cartpole-{name}", *arguments]).returncode
    if code:
        sys.exit(code)


def evaluate(folder: Path, plant: str) -> dict:
    """The last checkpoint's metrics on `plant`."""
    into = f"{folder}/{plant}"
    run = f"{folder}/train"
    command("evaluate", f"hydra.run.dir={into}", f"run={run}", f"plant={plant}", f"episodes={EPISODES}")
    return json.loads(Path(into, "metrics.json").read_text())


def mean_text(figure: dict | None) -> str:
    """A mean with its interval; "never" where no episode has it."""
    return "never" if figure is None else interval_text(figure["mean"], figure["low"], figure["high"])


def show(results: dict[str, dict]) -> None:
    """Table of both evaluations."""
    figures = {
        "score": "score (6.2)",
        "score_upright": "score upright (6.1)",
        "time_to_upright_s": "time to upright, s",
        "upright_fraction": "share of time upright",
        "min_track_margin_m": "nearest to the track's end, m",
    }
    rows = [
        {"figure": label} | {plant: mean_text(result[key]) for plant, result in results.items()}
        for key, label in figures.items()
    ]
    print("\nThe last checkpoint, 10 episodes each, mean and 95 % interval")
    print(table(rows, {"figure": "", "simulated": "simulated", "emulated": "emulated"}))


if __name__ == "__main__":
    main()
