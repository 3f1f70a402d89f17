#!/usr/bin/env python
"""How well do agents drive emulated carts that they never saw?

    scripts/bench/zero_shot.py runs/train/a runs/train/b --jobs 2 --json zero_shot.json
    scripts/bench/zero_shot.py runs/train/a runs/train/b --wider 0.333 --jobs 2 --json wider.json

The last checkpoint of each agent drives the same `--truths` carts, `--starts` episodes on each. A cart is a
separate process with MuJoCo physics, driven over its serial port; it is new for each agent and homes once. A
fraction is the mean score on a cart divided by the reference of the same cart (reference.py --truths), the
best score that a search with full knowledge found on a simulated cart with the same numbers. A cart is beaten
if an episode scores more than its reference, which is then too low. An episode with a score below 500 is
lost. An episode that cannot be driven, because homing fails, has no score and is counted separately.

The carts are drawn inside the ranges of `randomization=wide`, except for the stiction ratio, which training
does not vary. With `--wider` most carts have some numbers outside those ranges. Settings were compared on
the carts of `--seed 0`, so scores on those carts are biased: report the carts of another seed.

The JSON file is written after each cart. If it exists, the carts that it holds are not driven again.
"""

import argparse
import json
from collections.abc import Iterator
from concurrent.futures import as_completed
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    LOST_SCORE,
    add_wider_option,
    min_median_max,
    option_parser,
    positive_int,
    print_table,
    processes,
    read_json,
    write_json,
)
from truth_references import Draw, known_references, note_missing
from truths import COMPARED, REPORTED, Truth

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import PlantError
from cartpole_rl.evaluation.episodes import Policy, run_episodes
from cartpole_rl.reporting.texts import Cell
from cartpole_rl.workflows.build import TrainedAgent, evaluated_env, evaluated_settings, trained_agent
from cartpole_rl.workflows.config import EvaluateConfig, load_settings

Scores = list[float | None]  # of the episodes on one cart; None for one that was not driven
DRAW = ("seed", "wider", "starts")  # the options that decide which episodes are driven
Driven = dict[str, dict[int, Scores]]  # by run folder and number of the cart


# driving


@cache
def agent_of(run: str) -> TrainedAgent:
    """Return the agent of a run folder's last checkpoint."""
    return trained_agent(Path(run))


def drive(run: str, truth: Truth, starts: int) -> Scores:
    """Return the scores of the agent of `run` on a new emulated cart."""
    given = {"run": run, "episodes": starts, "plant": "emulated", "seed": 1, "threads": 1}
    config, agent = load_settings(EvaluateConfig, given), agent_of(run)
    config = config.model_copy(update={"emulator": EmulatorSettings.model_validate(truth)})
    with closing(evaluated_env(evaluated_settings(agent.training, config), config, print)) as env:
        return [episode_score(env, agent.policy, truth) for _ in range(starts)]


def episode_score(env: CartPoleEnv, policy: Policy, truth: Truth) -> float | None:
    """Return the score of one episode; None if the cart cannot be driven."""
    try:
        (episode,) = run_episodes(env, policy, 1)
    except PlantError as error:  # high friction can prevent homing
        print(f"not driven: {error}; {json.dumps(truth)}", flush=True)
        return None
    return round(float(episode.score.sum()), 1)


def drive_missing(
    driven: Driven, runs: list[str], truths: list[Truth], starts: int, jobs: int
) -> Iterator[tuple[str, int]]:
    """Drive each cart that `driven` does not hold and add its scores; yield its agent and number."""
    work = [(run, number) for number in range(len(truths)) for run in runs if number not in driven[run]]
    with processes(jobs) as pool:
        episodes = {pool.submit(drive, run, truths[number], starts): (run, number) for run, number in work}
        for done in as_completed(episodes):
            run, number = episodes[done]
            driven[run][number] = done.result()
            yield run, number


# figures


def agent_figures(run: str, driven: dict[int, Scores], references: list[float | None]) -> dict[str, Any]:
    """Return the figures of one agent; a fraction is None if no cart has one."""
    known = {cart: [score for score in scores if score is not None] for cart, scores in driven.items()}
    fractions, beaten = [], []
    for cart, scores in sorted(known.items()):
        if scores and (reference := references[cart]) is not None:
            fractions.append(float(np.mean(scores)) / reference)
            beaten += [cart] if max(scores) > reference else []
    episodes = [score for scores in known.values() for score in scores]
    lost = sum(score < LOST_SCORE for score in episodes)
    return {
        "run": run,
        "mean_fraction": float(np.mean(fractions)) if fractions else None,
        "worst_fraction": min(fractions, default=None),
        "lost": lost,
        "lost_share": lost / len(episodes) if episodes else None,
        "not_driven": sum(len(scores) for scores in driven.values()) - len(episodes),
        "episodes": len(episodes),
        "beaten": beaten,
        "scores": {str(cart): driven[cart] for cart in sorted(driven)},
    }


def all_figures(driven: Driven, references: list[float | None]) -> list[dict[str, Any]]:
    """Return the figures of every agent."""
    return [agent_figures(run, carts, references) for run, carts in driven.items()]


def agent_row(agent: dict[str, Any]) -> dict[str, Cell]:
    """Return the table row of one agent."""
    return {
        "run": agent["run"],
        "carts": len(agent["scores"]),
        "mean fraction": agent["mean_fraction"],
        "worst cart": agent["worst_fraction"],
        "lost": agent["lost"],
        "lost share": agent["lost_share"],
        "not driven": agent["not_driven"],
        "beaten": len(agent["beaten"]),
    }


def overall_rows(agents: list[dict[str, Any]]) -> list[dict[str, Cell]]:
    """Return the table rows with minimum, median and maximum over the agents."""
    decimals = {"mean_fraction": 3, "worst_fraction": 3, "lost": 0, "lost_share": 4, "not_driven": 0}
    figures = {name: [agent[name] for agent in agents] for name in decimals}
    return [
        {"figure": name.replace("_", " "), "agents": len(values), **min_median_max(values, decimals[name])}
        for name, values in figures.items()
        if None not in values
    ]


def note_beaten(agents: list[dict[str, Any]]) -> None:
    """Print how many references are too low, if any."""
    if beaten := {cart for agent in agents for cart in agent["beaten"]}:
        numbers = ", ".join(map(str, sorted(beaten)))
        print(f"the references of {len(beaten)} truths are too low, an agent scored more: {numbers}")


# the command


def earlier_scores(file: Path | None, draw: dict[str, Any], count: int) -> Driven:
    """Return the scores in the JSON file; exit if it has over `count` carts, or those of another draw."""
    if file is None or not file.exists():
        return {}
    known = read_json(file)
    if others := [f"--{key} {known.get(key)}" for key in draw if known.get(key) != draw[key]]:
        raise SystemExit(f"{file} was made with {', '.join(others)}: use that, or another --json file")
    driven = {
        agent["run"]: {int(cart): each for cart, each in agent["scores"].items()} for agent in known["agents"]
    }
    if (most := max(map(max, filter(None, driven.values())), default=0) + 1) > count:
        raise SystemExit(f"{file} holds {most} carts: use --truths {most}, or another --json file")
    return driven


def parse_options() -> argparse.Namespace:
    """Return the command-line options."""
    parser = option_parser(__doc__)
    parser.add_argument("runs", nargs="+", help="run folders of cartpole-train")
    parser.add_argument(
        "--truths", type=positive_int, default=100, help="number of carts, the same for every agent (100)"
    )
    parser.add_argument("--starts", type=positive_int, default=5, help="episodes on each cart (5)")
    parser.add_argument(
        "--seed",
        type=int,
        default=REPORTED,
        help=f"decides which carts are drawn: {REPORTED} (default) for reports; {COMPARED} gives the carts "
        "on which settings are compared",
    )
    add_wider_option(parser)
    parser.add_argument("--jobs", type=positive_int, default=1, help="carts driven at the same time (1)")
    return parser.parse_args()


def main() -> None:
    """Judge each agent, print the tables and write the figures."""
    options = parse_options()
    draw, options_of_draw = Draw(options.seed, options.wider), {name: getattr(options, name) for name in DRAW}
    truths = draw.truths(options.truths)
    references = known_references(draw, truths)
    note_missing(draw, references)
    driven: Driven = {run: {} for run in options.runs}
    driven |= earlier_scores(options.json, options_of_draw, options.truths)
    for run, number in drive_missing(driven, options.runs, truths, options.starts, options.jobs):
        print(f"{run}, cart {number}: {driven[run][number]}", flush=True)
        write_json(options.json, {**options_of_draw, "agents": all_figures(driven, references)})
    agents = all_figures(driven, references)
    write_json(options.json, {**options_of_draw, "agents": agents})
    print_table([agent_row(agent) for agent in agents])
    print()
    print_table(overall_rows(agents))
    note_beaten(agents)


if __name__ == "__main__":
    main()
