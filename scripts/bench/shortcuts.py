#!/usr/bin/env python
"""Speed of this package's replacements of TorchRL parts, measured in one process and in turns.

    scripts/bench/shortcuts.py [--json shortcuts.json] [--carts 1024] [--seconds 60] [--quick]

Each group does the same work; tests show that it gives the same numbers. Carts are compiled, as in training:

- a step with resets: `CartPoleEnv.step_and_maybe_reset` beside that of TransformedEnv, over equal plants;
- collecting 8 periods: `learning.collector.Collector` beside `torchrl.collectors.Collector`, both on a
  CartPoleEnv, with the same network and epsilon-greedy exploration;
- the greedy action of one cart: `DrivingPolicy`, traced and compiled, beside the QValueActor;
- a gradient of 512 transitions: `LossGradient`, plain and compiled, beside `backward` and clipping.

A time is the processor time of the fastest of many calls, in which the rows take turns, with one thread.
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from environment import Step, stepper
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector as StockCollector
from torchrl.envs import TransformedEnv
from torchrl.modules import EGreedyModule

from cartpole_rl.agents.dqn import QAgent
from cartpole_rl.agents.loss import LossGradient, columns_of
from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.gymnasium import simulated_environment
from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.learning.buffer import n_step_transitions
from cartpole_rl.learning.collector import Collector
from cartpole_rl.reporting.table import table

CHUNK, EPSILON, BATCH = 8, 0.1, 512
Pair = dict[str, Step]  # TorchRL's part first


def environment(carts: int, compiled: bool) -> CartPoleEnv:
    """The swing-up on `carts` randomized carts."""
    return simulated_environment("swingup", carts, "wide", compiled)


def make_agent(env: CartPoleEnv) -> QAgent:
    """An untrained agent of the default settings."""
    signs = env.hardware.observation_settings.mirror_signs
    return QAgent(AgentSettings(**choice("agent/dqn")), signs, len(env.hardware.motors))


def steps(carts: int, compiled: bool) -> Pair:
    """One step with resets, under random actions."""
    ours, parts = environment(carts, compiled), environment(carts, compiled).hardware
    settings = parts.task, parts.observation_settings, parts.reward
    hardware = HardwareTransform(parts.motors.tolist(), *settings, compiled=compiled)
    stock = TransformedEnv(environment(carts, compiled).plant, hardware)
    actions = torch.randint(len(parts.motors), (16, carts))
    return {
        "TransformedEnv, step": stepper(stock, stock.reset(), actions),
        "CartPoleEnv, step": stepper(ours, ours.reset(), actions),
    }


def collections(carts: int, compiled: bool) -> Pair:
    """A chunk of CHUNK periods."""
    env = environment(carts, compiled)
    agent = make_agent(env)
    ours = Collector(env, agent.actor, len(env.hardware.motors), seed=0)
    ours.epsilon = EPSILON
    explore = EGreedyModule(env.action_spec_unbatched, eps_init=EPSILON, eps_end=EPSILON)
    stock = StockCollector(
        environment(carts, compiled),
        TensorDictSequential(agent.actor, explore),
        frames_per_batch=CHUNK * carts,
    )
    return {"TorchRL's collector": partial(next, iter(stock)), "our collector": partial(ours.collect, CHUNK)}


def choices(agent: QAgent, size: int, compiled: bool) -> Pair:
    """The greedy action of one cart for an observation of `size` numbers."""
    policy = agent.greedy_policy()
    present = TensorDict({"observation": torch.randn(1, size)}, [1])
    ways = {
        "QValueActor": policy,
        "DrivingPolicy, traced": DrivingPolicy(policy),
        "DrivingPolicy": DrivingPolicy(policy, compiled),
    }
    return {name: partial(torch.no_grad()(way), present) for name, way in ways.items()}


def gradients(agent: QAgent, chunk: TensorDict, compiled: bool) -> Pair:
    """The clipped gradient of the loss of BATCH transitions."""
    batch = n_step_transitions(chunk, 5, 0.99)[:BATCH]
    max_norm = choice("optimizer/adam")["max_grad_norm"]
    weights = list(agent.loss.parameters())

    def stock() -> None:
        agent.loss.zero_grad()
        agent.loss(batch)["loss"].backward()
        nn.utils.clip_grad_norm_(weights, max_norm)

    columns = columns_of(batch)
    return {
        "loss.backward": stock,
        "LossGradient, not compiled": partial(LossGradient(agent.loss, max_norm), columns),
        "LossGradient": partial(LossGradient(agent.loss, max_norm, compiled), columns),
    }


def seconds(call: Step) -> float:
    """Processor time of one call, after one that fills the caches."""
    call()
    started = time.thread_time()
    call()
    return time.thread_time() - started


def measure(carts: int, budget: float, compiled: bool) -> list[dict[str, Any]]:
    """Return the milliseconds per call of each variant, and its speed-up over TorchRL."""
    env = environment(carts, compiled)
    agent = make_agent(env)
    chunk = Collector(env, agent.actor, len(env.hardware.motors), seed=0).collect(CHUNK)
    size = chunk["observation"].shape[-1]
    pairs = [
        steps(carts, compiled),
        collections(carts, compiled),
        choices(agent, size, compiled),
        gradients(agent, chunk, compiled),
    ]
    calls = {name: call for pair in pairs for name, call in pair.items()}
    best = dict.fromkeys(calls, float("inf"))
    end = time.perf_counter() + budget
    while time.perf_counter() < end or float("inf") in best.values():
        for name, call in calls.items():
            best[name] = min(best[name], seconds(call))
    return [
        {"name": name, "ms": 1e3 * best[name], "to": stock, "ratio": best[stock] / best[name]}
        for pair in pairs
        for stock in list(pair)[:1]
        for name in pair
    ]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results there")
    parser.add_argument("--carts", type=int, default=1024, help="simulated in parallel (default: 1024)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of rounds (default: 60)")
    parser.add_argument("--quick", action="store_true", help="one round, not compiled: only that it runs")
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    results = measure(options.carts, 0.0 if options.quick else options.seconds, not options.quick)
    print(table(results, {"name": "", "ms": "ms per call", "ratio": "speed-up", "to": "as"}))
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
