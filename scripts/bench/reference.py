#!/usr/bin/env python
"""What is the best score on a simulated cart? Searches for it from hanging, with full knowledge of the cart.

    scripts/bench/reference.py pole=large                          # overrides of cartpole-train
    scripts/bench/reference.py --length 0.4 --states 1000          # a rod of the length experiment
    scripts/bench/reference.py --all --json scripts/bench/references.json
    scripts/bench/reference.py --truths 100 --seed 2026 --wider 0.333 --jobs 2   # carts of zero_shot.py

The search runs offline and learns nothing. It could not run on a cart: it knows the true state, the
equations and every encoder count. Its result is a score that was reached by replaying the actions in the
environment, so the best possible score is that or higher.

For each start the search has three stages (scripts/bench/best_score):

1. Swing-up (`evolved`). The quickest swing-ups push with full force to one side, then to the other, and so
   on. Twelve durations describe one; the force levels in between give fractions of a step. Eight
   populations of durations evolve separately. A swing-up is judged by the points lost until the pole stands
   and by the distance from standing at that moment; the populations weigh the two differently.
2. Landing (`landed`). A beam search over all actions replaces the last steps. It keeps the best state of
   each small cell of the state space, and the best `--states` of all cells. The best four populations land;
   the best landing continues.
3. Holding (`held`). Beam search with 300 states and 40 steps ahead, of which 20 are kept.

The search runs with 1000 states (swing-ups in a generation, states in a landing), then with three times as
many, up to `--states`. The best result is kept, so that more states never find less.

`--truths` searches a simulated cart with the numbers of each drawn truth (truths.py), from 0 m only and with
1000 states unless `--states` says otherwise. Its latency has no jitter. Each score is written to
truth_references/ when it is found; the ones that are there are not searched again.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from typing import Any, NamedTuple

import numpy as np
import torch
from best_score.beam import held, landed, risk
from best_score.cart import MOST, KnownCart, hanging, wrapped
from best_score.swing_up import GENERATIONS, evolved, lacking, pushed
from common import (
    add_wider_option,
    option_parser,
    overrides_of,
    positive_int,
    processes,
    read_json,
    write_json,
)
from truth_references import Draw, add_reference, known_references
from truths import REPORTED, Truth, simulated_cart

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.errors import CartPoleError, ConfigError
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.tasks.episode import upright_since
from cartpole_rl.tasks.rewards import BONUS, UPRIGHT_ANGLE
from cartpole_rl.tasks.settings import Start, StartSettings
from cartpole_rl.workflows.config import TrainConfig, load_settings

STARTS = (-0.1, -0.05, 0.0, 0.05, 0.1)  # m: an evaluation places the cart within 0.1 m of the middle
POLES = ("medium", "large")
LENGTHS = tuple(tenths / 10 for tenths in range(2, 11))  # m, of the length experiment
ALONE = {"randomization": "none", "guard": "none"}  # nothing is drawn, and full knowledge needs no guard
FIRST_RUNG, RUNG = 1000, 3  # states of the first search, and the factor to the next
WIDEST = 3000  # states, unless given
LANDED = 4  # populations whose winners land
HELD = 2  # landings that continue to the end of the episode


# the search


def search(cart: KnownCart, position: float, states: int, generations: int = GENERATIONS) -> list[int]:
    """Return the actions of the best episode found from hanging at `position` m."""
    found: list[list[int]] = []
    for rung in rungs(states):
        generator = torch.Generator().manual_seed(rung)
        swings = evolved(cart, position, rung, generations, generator)
        sequences: list[list[int]] = []
        swings = swings.at(torch.arange(LANDED))
        for swing, arrival in zip(pushed(cart, swings.pushes, cart.steps), swings.arrival, strict=True):
            sequences += landed(cart, position, swing.tolist(), int(arrival), rung)
        sequences.sort(key=partial_loss(cart, position))
        found += [held(cart, position, sequence) for sequence in sequences[:HELD]]
    return max(found, key=lambda actions: float(cart.run(cart.hanging(position), actions).points))


def rungs(states: int) -> Iterator[int]:
    """Yield 1000, 3000, 9000 and so on, up to and including `states`."""
    rung = FIRST_RUNG
    while rung < states:
        yield rung
        rung *= RUNG
    yield states


def partial_loss(cart: KnownCart, position: float) -> Callable[[list[int]], float]:
    """Return the loss that ranks sequences of different lengths: points lost so far and to be lost later."""

    def loss(actions: list[int]) -> float:
        nodes = cart.run(cart.hanging(position), actions)
        upright = wrapped(nodes.state.theta).abs() < UPRIGHT_ANGLE
        end = torch.where(upright, risk(cart, nodes.state), lacking(cart, nodes.state))
        return float(MOST * len(actions) - nodes.points + end)

    return loss


# the replay in the environment


class Replay(NamedTuple):
    """An episode in the environment."""

    points: list[float]  # score (6.2) of each step
    theta: list[float]  # rad, measured: at the start and after each step

    def figures(self, period: float) -> dict[str, float | None]:
        """Return the figures of one start in the JSON file."""
        angle = np.abs(np.array(self.theta[1:]))
        upright = angle < UPRIGHT_ANGLE
        still = np.array(self.points) >= 2 * BONUS
        moments = period * np.arange(len(self.theta), dtype=np.float64)
        return {
            "score": round(sum(self.points), 1),
            "time_to_upright_s": upright_since(moments, np.array(self.theta)),
            "upright_fraction": float(upright.mean()),
            "still_fraction_of_upright": float(still.sum() / max(upright.sum(), 1)),
        }


def replay(config: TrainConfig, position: float, actions: Sequence[int]) -> Replay:
    """Run actions in the environment, from hanging at `position` m, until the episode ends."""
    still = StartSettings(
        angle=Start.HANGING, position_spread=0, angle_spread=0, speed_spread=0, angular_speed_spread=0
    )
    env = simulated_env(config, config.plant, 1, still, 0)
    assert isinstance(env.plant, SimulatedPlant)
    step = env.reset()
    env.plant.place(hanging(position))  # after this the score depends on no earlier frame
    states, points = [step["state"][0]], []
    for action in actions:
        step = env.step(step.set("action", torch.tensor([action])))["next"]
        states.append(step["state"][0])
        points.append(float(step["score"]))
        if step["done"].any():
            break
    return Replay(points, [float(state[2]) for state in states])


def reference(config: TrainConfig, states: int) -> dict[str, Any]:
    """Return the best scores found from each of STARTS, their mean, and the cost of the search.

    A symmetric cart is searched on one side only: mirrored episodes have the same score.
    """
    cart, started = KnownCart(config, compiled=True), time.process_time()
    by_start: dict[float, dict[str, float | None]] = {}
    for position in STARTS[::-1]:
        if cart.symmetric and position < 0:
            by_start[position] = by_start[-position]
        else:
            actions = search(cart, position, states)
            by_start[position] = replay(config, position, actions).figures(config.control_period)
    return {
        "score": round(float(np.mean([figures["score"] for figures in by_start.values()])), 1),
        "states": states,
        "seconds": round(time.process_time() - started, 1),
        "starts": {f"{position:g} m": by_start[position] for position in STARTS},
    }


def truth_config(truth: Truth) -> TrainConfig:
    """Return the settings of a simulated cart with the numbers of a truth."""
    return known_config(simulated_cart(truth))


def known_config(cart: dict[str, float], **settings: object) -> TrainConfig:
    """Return the settings of a simulated cart with the friction laws of an emulated one, for a search."""
    cart = {**cart, "latency_jitter": 0.0}  # a search cannot foresee draws
    pole = {name: cart.pop(name) for name in Pole.model_fields}
    friction = {"cart_friction": "stribeck", "pole_friction": "bearing"}
    choices = {"cart": cart, "pole": {"choices": {"truth": pole}}, **ALONE}
    return load_settings(TrainConfig, {**settings, **choices, **friction})


def truth_reference(states: int, truth: Truth) -> dict[str, Any]:
    """Return the best score found on the simulated cart of a truth from 0 m, and the cost of the search."""
    return known_reference(truth_config(truth), states)


def known_reference(config: TrainConfig, states: int) -> dict[str, Any]:
    """Return the best score found on a simulated cart from 0 m, and the cost of the search."""
    started = time.process_time()
    actions = search(KnownCart(config, compiled=True), 0.0, states)
    score = round(sum(replay(config, 0.0, actions).points), 1)
    return {"score": score, "states": states, "seconds": round(time.process_time() - started, 1)}


def search_truths(draw: Draw, count: int, states: int, jobs: int) -> None:
    """Search the references of the first truths of a draw that are not known, and write each when found."""
    truths = draw.truths(count)
    known = known_references(draw, truths)
    numbers = [number for number, score in enumerate(known) if score is None]
    with processes(jobs) as pool:
        searches = {pool.submit(truth_reference, states, truths[number]): number for number in numbers}
        for done in as_completed(searches):
            number, found = searches[done], done.result()
            add_reference(draw, number, truths[number], found)
            print(f"truth {number}: {found['score']:.0f}, {found['seconds']:.0f} s", flush=True)


# the command


def composed(overrides: Sequence[str]) -> TrainConfig:
    """Return the settings of cartpole-train with `overrides`, on the nominal cart. Raises ConfigError."""
    return load_settings(TrainConfig, {**overrides_of(overrides), **ALONE})


def with_rod(config: TrainConfig, length: float) -> TrainConfig:
    """Return the config with a uniform rod of `length` m."""
    name = f"{length:.1f} m"
    return config.model_copy(update={"pole": PoleSettings(choices={name: Pole.rod(length)})})


def plants(options: argparse.Namespace) -> list[TrainConfig]:
    """Return the configs that the options ask for. Raises ConfigError."""
    if options.states < 1:
        raise ConfigError(f"--states {options.states} must be at least 1")
    if options.length is not None and not options.length > 0:
        raise ConfigError(f"--length {options.length:g} must be above 0")
    if options.all:
        poles = [composed([*options.overrides, f"pole={pole}"]) for pole in POLES]
        return poles + [with_rod(composed(options.overrides), length) for length in LENGTHS]
    config = composed(options.overrides)
    return [config if options.length is None else with_rod(config, options.length)]


def summary(name: str, found: dict[str, Any]) -> str:
    """Return a heading and one line for each start."""
    lines = [f"{name}: mean score {found['score']:.0f}, {found['states']} states, {found['seconds']:.0f} s"]
    for start, figures in found["starts"].items():
        upright = figures["time_to_upright_s"]
        lines.append(
            f"  from {start}: {figures['score']:.0f}, "
            + ("never upright" if upright is None else f"upright after {upright:.2f} s")
            + f", still in {100 * figures['still_fraction_of_upright']:.1f} % of its upright steps"
        )
    return "\n".join(lines)


def main() -> None:
    """Search, print the scores, and add them to a JSON file whose keys are the names of the plants."""
    parser = option_parser(__doc__)
    parser.add_argument("overrides", nargs="*", help="overrides of cartpole-train")
    parser.add_argument("--states", type=int, help="of the widest search (3000; with --truths 1000)")
    parser.add_argument("--length", type=float, metavar="M", help="a uniform rod of M metres as the pole")
    parser.add_argument("--all", action="store_true", help="both poles and rods of 0.2 to 1.0 m")
    parser.add_argument("--truths", type=positive_int, metavar="N", help="the first N drawn truths")
    parser.add_argument("--seed", type=int, default=REPORTED, help=f"of the truths ({REPORTED})")
    add_wider_option(parser)
    parser.add_argument("--jobs", type=positive_int, default=1, help="truths searched at the same time (1)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.truths:
        draw = Draw(options.seed, options.wider)
        search_truths(draw, options.truths, options.states or FIRST_RUNG, options.jobs)
        return
    options.states = WIDEST if options.states is None else options.states
    try:
        configs = plants(options)
    except CartPoleError as error:
        sys.exit(f"reference: {error}")
    for config in configs:
        found = reference(config, options.states)
        print(summary(config.pole.name, found), flush=True)
        if options.json:
            known = read_json(options.json) if options.json.exists() else {}
            write_json(options.json, {**known, config.pole.name: found})


if __name__ == "__main__":
    main()
