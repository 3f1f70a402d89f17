#!/usr/bin/env python
"""Does every episode on a failing cart end with a reason and with the motor at 0?

    scripts/fuzz/soak.py --episodes 200 --seed 0 --clock lockstep

Each emulated cart is a separate process. It loses, corrupts, duplicates and reorders a drawn share of the
frames, and it may restart its firmware or freeze an encoder. It is driven for up to four episodes with
random motor values, through the same plant and environment as a trained agent. The cart's own journal then
says how long after the last command of each drive the motor was at 0, or at the value of the cart's brake,
which stops a cart that runs towards its end stop.

Prints a table of the endings. Exit status 1 if a motor was not at 0 within 60 ms after a drive. An
exception outside the package's error classes ends the run with its traceback.
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
from cartpole_rl.envs.build import make_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import ObservationSettings
from cartpole_rl.errors import PlantError
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.reporting.texts import table
from cartpole_rl.tasks.settings import ActionSettings, RewardSettings, TaskSettings

EPISODES_PER_CART = 4  # fewer if the cart fails for good
LARGEST_SHARE = 0.05  # of frames, of each disturbance
FAILURE_TIME = (25.0, 90.0)  # s since the start; homing takes 25
BRAKE = 255  # size of the brake's motor value; no action has it
LIMIT_MS = 60  # three periods: the watchdog
DRIVES = ("START", "HOME")  # commands after which the motor may move again


def draw_truth(random: np.random.Generator, clock: str, journal: Path) -> EmulatorSettings:
    """Draw a cart with disturbed frames and possibly a restart or a frozen encoder."""
    frames = ("frame_loss", "frame_corruption", "frame_duplication", "frame_reordering")
    truth: dict[str, Any] = {name: float(random.uniform(0, LARGEST_SHARE)) for name in frames}
    failure, moment = random.integers(4), float(random.uniform(*FAILURE_TIME))
    if failure == 1:
        truth["reset_at"] = moment
    elif failure > 1:
        truth |= {"stuck_encoder": ("cart", "pole")[failure - 2], "stuck_at": moment}
    truth |= {"clock": clock, "seed": int(random.integers(2**31)), "journal": journal}
    return EmulatorSettings(physics_step=1e-3, **truth)


def environment(truth: EmulatorSettings) -> CartPoleEnv:
    """Return the swing-up on an emulated cart, with the settings of conf/."""
    task = choice("task/swingup") | {"x_max": choice("cart/ip02")["track_half_length"]}
    return make_env(
        emulated_plant(truth),
        ActionSettings(**choice("actions/nine_levels")),
        TaskSettings(**task).at(choice("train")["control_period"]),
        ObservationSettings(**choice("observation/history")),
        RewardSettings(**choice("reward/score")),
    )


class RandomPushes:
    """A policy of random motor values and durations, more often towards the middle of the track."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random, self._left, self._action = random, 0, 0

    def __call__(self, present: TensorDictBase) -> TensorDictBase:
        """Add the `action` for an `observation` [1, K] whose first number is the position."""
        if self._left == 0:
            x = float(present["observation"][0, 0])
            right = self._random.random() < 0.5 - x
            self._action = int(self._random.integers(5, 9) if right else self._random.integers(4))
            self._left = int(self._random.integers(1, 6))
        self._left -= 1
        return present.set("action", torch.tensor([self._action]))


def drive(truth: EmulatorSettings, episodes: int, random: np.random.Generator) -> Iterator[str]:
    """Yield how each episode on one cart ended; an episode that cannot begin is the last."""
    try:
        with closing(environment(truth)) as env:
            for _ in range(episodes):
                (episode,) = run_batch(env, RandomPushes(random))
                error = getattr(env.plant, "last_error", None)
                yield f"{episode.ended_by}: {reason(error)}" if error else episode.ended_by
    except PlantError as error:
        yield f"did not begin: {reason(error)}"


def reason(error: PlantError) -> str:
    """Return an error message without its remedy and without the name of the port."""
    words = str(error).split(" (")[0].split(": check")[0]
    return " ".join("PORT" if "/dev/" in word else word for word in words.split())


def stop_times(journal: Path) -> list[float]:
    """Return the ms from the last accepted motor value to motor 0 or the brake, for each arming."""
    times, last, zero = list[float](), None, 0
    moving = False  # the motor value in force is neither 0 nor the brake's

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
            was_moving, moving = moving, abs(event["in_force"]) not in (0, BRAKE)
            if moving or was_moving:
                zero = event["us"]
    note()
    return times


def main() -> None:
    """Drive, count, check the journals and print a summary."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=200, help="episodes in all (200)")
    parser.add_argument("--seed", type=int, default=0, help="of the carts and motor values (0)")
    parser.add_argument(
        "--clock", choices=("lockstep", "real"), default="lockstep", help="of the emulated carts"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    random = np.random.default_rng(options.seed)
    endings: Counter[str] = Counter()
    stops: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        carts = 0
        while endings.total() < options.episodes:
            journal = Path(folder, f"{carts}.jsonl")
            episodes = min(EPISODES_PER_CART, options.episodes - endings.total())
            for ending in drive(draw_truth(random, options.clock, journal), episodes, random):
                endings[ending] += 1
            stops += stop_times(journal)
            carts += 1
            print(f"{endings.total()} episodes on {carts} carts", file=sys.stderr, flush=True)
    rows = [{"ending": ending, "episodes": str(count)} for ending, count in endings.most_common()]
    print(table(rows, {"ending": "ending", "episodes": "episodes"}))
    late = sum(stop > LIMIT_MS for stop in stops)
    print(
        f"{carts} carts, armed {len(stops)} times; time from the last command to motor 0 or the brake: "
        f"{np.median(stops):.1f} ms (median), {max(stops):.1f} ms (longest); over {LIMIT_MS} ms: {late}"
    )
    sys.exit(late > 0)


if __name__ == "__main__":
    main()
