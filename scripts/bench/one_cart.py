#!/usr/bin/env python
"""Speed of everything that drives one cart.

    scripts/bench/one_cart.py [--json one_cart.json] [--episodes 10] [--steps 20000]

Three measurements, with one thread:

- steps per second of the single Gymnasium environments under random actions, beside Gymnasium's own CartPole
  in the same run;
- seconds per episode of 500 steps on an emulated lockstep cart, which includes its re-centring; the cart
  stands still, while a network of the default size computes its actions;
- the host's part of a tick, from the arrival of a state to the end of writing its command: median, 99.9th
  percentile and longest, alone and beside a process that multiplies matrices at a learner's priority. The
  host has real-time priority, as it has for a cart with its own clock, if the system allows it.
"""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from multiprocessing import get_context
from typing import Any

import gymnasium
import torch
from common import option_parser, positive_int, print_table, write_json
from tensordict import TensorDictBase

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.build import environment, shipped_settings
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.evaluation.episodes import run_episodes
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.plants.serial.plant import emulated_plant
from cartpole_rl.scheduling import giving_precedence, taking_precedence

PEER = "CartPole-v1"
OURS = ("cartpole_rl/SwingUp-v0", "cartpole_rl/Balance-v0")
MATRIX = 512


def steps_per_second(name: str, steps: int) -> float:
    """Return how many steps with random actions a second takes, resets included."""
    env = gymnasium.make(name).unwrapped
    env.action_space.seed(0)
    env.reset(seed=0)
    env.step(0)
    started = time.perf_counter()
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return steps / (time.perf_counter() - started)


class StandingStill:
    """Computes the action values of an untrained network of the default settings, and chooses motor 0."""

    def __init__(self, signs: list[int], motors: list[int]) -> None:
        agent = QAgent(AgentSettings(**choice("agent/dqn")).at(0.02), signs, len(motors))
        self.network, self.action = DrivingPolicy(agent.greedy_policy()), torch.tensor([motors.index(0)])

    def __call__(self, present: TensorDictBase) -> TensorDictBase:
        """Return the values, and the action of motor 0."""
        return self.network(present).set("action", self.action)


def multiply() -> None:
    """Keep a core busy until the process ends, with the low priority of a fine-tuning's learner."""
    torch.set_num_threads(1)
    matrix = torch.rand(MATRIX, MATRIX)
    with giving_precedence():
        while True:
            matrix = torch.nn.functional.normalize(matrix @ matrix)


@contextmanager
def busy_process() -> Iterator[None]:
    """Multiply matrices in another process within the `with`."""
    process = get_context("spawn").Process(target=multiply, daemon=True)
    process.start()
    try:
        yield
    finally:
        process.kill()
        process.join()


def lockstep(episodes: int, beside: bool) -> dict[str, Any]:
    """Return the time of an episode and of the host's ticks, `beside` a busy process or alone."""
    settings = shipped_settings({"pole": "medium"})
    with (
        busy_process() if beside else nullcontext(),
        taking_precedence(),
        closing(environment(settings, emulated_plant(EmulatorSettings()))) as env,
    ):
        policy = StandingStill(settings.observation.mirror_signs, list(settings.actions.motors))
        for _ in run_episodes(env, policy, 1):
            env.plant.cart.statistics.clear()
        started = time.perf_counter()
        steps = sum(episode.steps for episode in run_episodes(env, policy, episodes))
        passed = time.perf_counter() - started
        link = env.plant.cart.statistics.summary()
    return {
        "s_per_episode": passed / episodes,
        "steps": steps,
        "median_ms": link["latency_median_ms"],
        "p999_ms": link["latency_p999_ms"],
        "longest_ms": link["latency_max_ms"],
    }


def main() -> None:
    """Measure, print, write."""
    parser = option_parser(__doc__)
    parser.add_argument("--steps", type=positive_int, default=20_000, help="of Gymnasium (default: 20000)")
    parser.add_argument("--episodes", type=positive_int, default=10, help="in lockstep (default: 10)")
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    peer = steps_per_second(PEER, options.steps)
    rates = {name: steps_per_second(name, options.steps) for name in OURS}
    rows: list[dict[str, Any]] = [
        {"environment": name, "steps_per_s": rate, "ratio": rate / peer}
        for name, rate in [(PEER, peer), *rates.items()]
    ]
    ticks: list[dict[str, Any]] = [
        {"lockstep": name, **lockstep(options.episodes, beside)}
        for name, beside in (("alone", False), ("beside a busy process", True))
    ]
    print_table(
        [{**row, "steps_per_s": f"{row['steps_per_s']:.0f}", "ratio": f"{row['ratio']:.2f}"} for row in rows]
    )
    print_table(
        [
            {key: f"{value:.3f}" if isinstance(value, float) else value for key, value in row.items()}
            for row in ticks
        ]
    )
    write_json(options.json, {"gymnasium": rows, "lockstep": ticks})


if __name__ == "__main__":
    main()
