"""The demo after its installation: train, evaluate, fine-tune, compare. See scripts/demo."""

import json
import math
import subprocess
import sys
import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cartpole_rl.drawing import colours
from cartpole_rl.reporting import style
from cartpole_rl.reporting.texts import SCORES, count_text, mean_text, table

EPISODES = 10  # without exploration
TUNING_EPISODES = 5  # to learn from
BIN = Path(sys.executable).parent
SHOWN = ("score", "score_upright", "time_to_upright_s", "upright_fraction", "min_track_margin_m")
DOTS = -0.15  # offset of a column's dots, in columns
MEAN = 0.12  # offset of its mean and interval
SPREAD = 0.11  # half width of the cloud of dots
BOX = 0.07  # half width of a mean's line and of the box that is its interval

Array = NDArray[np.float64]


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
    style.save(comparison(results), folder / "comparison.png")
    print(f"scores:          {folder}/comparison.png")
    print(f"learning curve:  {folder}/train/figures/learning_curve.png")
    print(f"TensorBoard:     .venv/bin/tensorboard --logdir {folder}")


def comparison(results: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw each episode's score as a dot, the mean with a 95 % interval, and its ratio to the first mean.

    Figures 6.8 and 6.14 of the thesis show that ratio, of the real to the simulated score.
    `results` maps a name, such as "simulated", to the content of a metrics.json.
    """
    scores = {name: np.array([e["score"] for e in result["episodes"]]) for name, result in results.items()}
    figure = style.new_figure(height=4.6, width=max(5.0, 1.6 + 1.9 * len(scores)))
    axes = figure.subplots()
    style.dress(axes, y="score of an episode", grid="y")
    for column, (name, result) in enumerate(results.items()):
        _draw_result(axes, column, scores[name], result["score"])
    _name_columns(axes, scores)
    low, high = min(0.0, axes.get_ylim()[0]), axes.get_ylim()[1]
    axes.set_ylim(low, high + 0.05 * (high - low))  # else dots that lie close together are cut at the top
    subtitle = "dots: episodes,  line and box: their mean and its 95 % interval"
    style.title(axes, "The same agent on each cart", subtitle)
    return figure


def _draw_result(axes: Axes, column: int, scores: Array, mean: Mapping[str, Any]) -> None:
    """Draw one column: the dots, and next to them the mean with its interval."""
    colour, places = style.series_colour(column), column + DOTS + _sideways(scores.size)
    axes.plot(places, np.sort(scores), "o", color=colour, alpha=0.5, markersize=5, markeredgewidth=0)
    edges, height = [column + MEAN - BOX, column + MEAN + BOX], mean["mean"]
    if mean["low"] is not None:
        axes.fill_between(edges, mean["low"], mean["high"], color=colour, alpha=0.35, linewidth=0)
    axes.plot(edges, [height, height], color=colour, linewidth=2.5, solid_capstyle="butt")
    text, place = mean_text(mean) or "", (edges[1], height)
    style.note(axes, text, place, "data", (5, 0), va="center", fontsize=style.LABEL_SIZE)


def _sideways(episodes: int) -> Array:
    """Return offsets [episodes] in columns that keep neighbours of the sorted scores apart."""
    golden = (math.sqrt(5) - 1) / 2  # multiples of it modulo 1 fill an interval evenly
    places: Array = SPREAD * (2 * ((np.arange(episodes, dtype=np.float64) * golden + 0.5) % 1) - 1)
    return places


def _name_columns(axes: Axes, scores: Mapping[str, Array]) -> None:
    """Label each column with its name, its number of episodes, and its ratio to the first column."""
    first = float(next(iter(scores.values())).mean())
    names = []
    for column, (name, each) in enumerate(scores.items()):
        ratio = f"\n{each.mean() / first:.2f} × {next(iter(scores))}" if column and first else ""
        names.append(style.plain(f"{name}\n{count_text(each.size)}{ratio}"))
    axes.set_xticks(range(len(names)), names, fontsize=style.LABEL_SIZE, color=colours.INK)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.5, len(names) - 0.3)


if __name__ == "__main__":
    main()
