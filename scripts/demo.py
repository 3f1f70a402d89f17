"""The demo after its installation: train, evaluate, fine-tune, compare. See scripts/demo."""

import json
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path

from cartpole_rl.reporting.scores import SCORES, comparison, mean_text
from cartpole_rl.reporting.style import save
from cartpole_rl.reporting.texts import table

EPISODES = 10  # without exploration
TUNING_EPISODES = 5  # to learn from
BIN = Path(sys.executable).parent
SHOWN = ("score", "score_upright", "time_to_upright_s", "upright_fraction", "min_track_margin_m")


def main() -> None:
    """Train, evaluate in simulation, fine-tune on the emulated cart, and print a comparison."""
    started = time.perf_counter()
    training, tuning = overrides(sys.argv[1:])
    folder = Path("runs/demo") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    agent = f"run={folder}/train"
    step("1/3: train an agent in simulation")
    run("train", f"hydra.run.dir={folder}/train", "experiment=medium", *training)
    step("2/3: evaluate it in simulation")
    run("evaluate", f"hydra.run.dir={folder}/simulated", agent, "plant=simulated", f"episodes={EPISODES}")
    step("3/3: drive an emulated cart over its serial port, fine-tune the agent there, and drive again")
    episodes = (f"episodes={TUNING_EPISODES}", f"evaluation_episodes={EPISODES}")
    run("finetune", f"hydra.run.dir={folder}/finetune", agent, "plant=emulated", *episodes, *tuning)
    report(folder)
    print(f"The demo took {time.perf_counter() - started:.0f} s. Its results are in {folder}.")
    print(
        f"Next, watch the agent: .venv/bin/cartpole-evaluate run={folder}/finetune plant=emulated view=live"
    )


def overrides(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the overrides of cartpole-train, and those after `--`, of cartpole-finetune."""
    end = words.index("--") if "--" in words else len(words)
    return words[:end], words[end + 1 :]


def step(title: str) -> None:
    """Print the title of a step."""
    print(f"\n== {title}", flush=True)


def run(name: str, *arguments: str) -> None:
    """Run cartpole-`name`; exit with its status if it fails."""
    print(f"$ cartpole-{name} {' '.join(arguments)}", flush=True)
    status = subprocess.run([BIN / f"cartpole-{name}", *arguments], check=False).returncode
    if status:
        sys.exit(status)


def report(folder: Path) -> None:
    """Print the results on each cart, save the comparison figure and list all figures."""
    tuned = json.loads((folder / "finetune/comparison.json").read_text())
    results = {
        "simulated": json.loads((folder / "simulated/metrics.json").read_text()),
        "emulated": tuned["before"],
        "emulated, fine-tuned": tuned["after"],
    }
    print(f"\nThe last checkpoint on each cart: mean and 95 % interval of {EPISODES} episodes")
    rows = [
        {"figure": SCORES[key]}
        | {cart: mean_text(result[key]) or "never" for cart, result in results.items()}
        for key in SHOWN
    ]
    print(table(rows, {"figure": ""} | {cart: cart for cart in results}))
    simulated, before, after = (result["score"]["mean"] for result in results.values())
    print(
        f"ratio of the scores, emulated / simulated: {before / simulated:.2f}, "
        f"after fine-tuning {after / simulated:.2f}; kept: the policy {tuned['kept']} fine-tuning\n"
    )
    save(comparison(results), folder / "comparison.png")
    print(f"scores:          {folder}/comparison.png")
    print(f"learning curve:  {folder}/train/figures/learning_curve.png")
    print(f"TensorBoard:     .venv/bin/tensorboard --logdir {folder}")


if __name__ == "__main__":
    main()
