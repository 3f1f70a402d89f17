#!/usr/bin/env python
"""Many episodes on emulated carts that fail in every way they can: each ends with a reason and motor 0.

    scripts/fuzz/soak.py [--episodes 200] [--seed 0] [--clock lockstep]

Each cart is a process of its own with a drawn share of frames lost, corrupted, doubled and reordered, and by
chance a restart of its firmware or an encoder that sticks. It is driven for up to four episodes by random
motor values, through the same plant and environment as a trained agent. The cart's own journal then says how
long after the last command of each drive the motor was at 0.

Prints a table of the endings. Exit status 1 if the motor was not at 0 within 60 ms after a drive; any
exception but the package's own errors ends the run with its traceback.
"""

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.make import CartPoleEnv, make_env
from cartpole_rl.envs.settings import ObservationSettings, RewardSettings, TaskSettings
from cartpole_rl.errors import PlantError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.plants.emulated import emulated_plant
from cartpole_rl.reporting.table import table
from cartpole_rl.tasks.actions import ActionSettings

A_CART = 4  # episodes, unless it fails for good before
LARGEST_SHARE = 0.05  # of frames, of each disturbance
TROUBLE = (25.0, 90.0)  # s since the start, between which a restart or a stuck encoder falls: homing takes 25
WATCHDOG_US = 60_000
DRIVES = ("START", "HOME")  # commands after which the motor may move again


def draw_truth(random: np.random.Generator, clock: str, journal: Path) -> EmulatorSettings:
    """A cart with disturbed frames, and by chance with a restart or a stuck encoder."""
    frames = ("frame_loss", "frame_corruption", "frame_duplication", "frame_reordering")
    truth: dict[str, Any] = {name: float(random.uniform(0, LARGEST_SHARE)) for name in frames}
    trouble, moment = random.integers(4), float(random.uniform(*TROUBLE))
    if trouble == 1:
        truth["reset_at"] = moment
    elif trouble > 1:
        truth |= {"stuck_encoder": ("cart", "pole")[trouble - 2], "stuck_at": moment}
    seed = int(random.integers(2**31))
    return EmulatorSettings(clock=clock, seed=seed, journal=journal, physics_step=1e-3, **truth)


def environment(truth: EmulatorSettings) -> CartPoleEnv:
    """The swing-up on an emulated cart, with conf/'s choices."""
    task = choice("task/swingup") | {"x_max": choice("cart/ip02")["track_half_length"]}
    return make_env(
        emulated_plant(truth),
        ActionSettings(**choice("actions/nine_levels")),
        TaskSettings(**task),
        ObservationSettings(**choice("observation/history")),
        RewardSettings(**choice("reward/score")),
    )


class RandomPushes:
    """Motor values and durations at random, more often towards the middle of the track."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random, self._left, self._action = random, 0, 0

    def __call__(self, present: TensorDictBase) -> TensorDictBase:
        """The `action` for the `observation` [1, K], whose first number is the position."""
        if self._left == 0:
            x = float(present["observation"][0, 0])
            right = self._random.random() < 0.5 - x
            self._action = int(self._random.integers(5, 9) if right else self._random.integers(4))
            self._left = int(self._random.integers(1, 6))
        self._left -= 1
        return present.set("action", torch.tensor([self._action]))


def drive(truth: EmulatorSettings, random: np.random.Generator) -> Iterator[str]:
    """How each episode on one cart ended, or why it did not begin, which is the last on this cart."""
    try:
        with closing(environment(truth)) as env:
            for _ in range(A_CART):
                (episode,) = run_batch(env, RandomPushes(random))
                error = getattr(env.plant, "last_error", None)
                yield f"{episode.ended_by}: {reason(error)}" if error else episode.ended_by
    except PlantError as error:
        yield f"not begun: {reason(error)}"


def reason(error: PlantError) -> str:
    """The beginning of an error's words: without its remedy and this cart's port."""
    words = str(error).split(" (")[0].split(": check")[0]
    return " ".join("PORT" if "/dev/" in word else word for word in words.split())


def stop_times(journal: Path) -> list[float]:
    """Ms from the last motor value that was taken to motor 0, for each time that the cart was armed."""
    times, last, zero = [], None, 0
    moving = False  # the motor is at another value than 0

    def note() -> None:
        if last is not None:
            times.append(float("inf") if moving else max(0, zero - last) / 1000)

    for event in map(json.loads, journal.read_text().splitlines()):
        if event.get("took") in DRIVES:
            note()
            last = None
        elif event.get("motor"):
            last = event["us"]
        elif "in_force" in event:
            moving = event["in_force"] != 0
            zero = event["us"]
    note()
    return times


def main() -> None:
    """Drive, count, check the journals, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clock", choices=("lockstep", "real"), default="lockstep")
    given = parser.parse_args()
    torch.set_num_threads(1)
    random = np.random.default_rng(given.seed)
    endings: Counter[str] = Counter()
    stops: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        carts = 0
        while endings.total() < given.episodes:
            journal = Path(folder, f"{carts}.jsonl")
            for ending in drive(draw_truth(random, given.clock, journal), random):
                endings[ending] += 1
            stops += stop_times(journal)
            carts += 1
            print(f"{endings.total()} episodes on {carts} carts", file=sys.stderr, flush=True)
    rows = [{"ending": ending, "episodes": str(count)} for ending, count in endings.most_common()]
    print(table(rows, {"ending": "ending", "episodes": "episodes"}))
    late = sum(stop > WATCHDOG_US / 1000 for stop in stops)
    print(
        f"{carts} carts, armed {len(stops)} times; motor at 0 after the last command within "
        f"{np.median(stops):.1f} ms (median), {max(stops):.1f} ms (longest); over 60 ms: {late}"
    )
    sys.exit(late > 0)


if __name__ == "__main__":
    main()
