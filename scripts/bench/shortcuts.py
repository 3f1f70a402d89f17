#!/usr/bin/env python
"""Speed of this package's replacements of TorchRL parts, measured in one process and in turns.

    scripts/bench/shortcuts.py [--json shortcuts.json] [--carts 1024] [--seconds 60]

Each group does the same work; tests show that it gives the same numbers. Carts are compiled, as in training:

- a step with resets: `CartPoleEnv.step_and_maybe_reset` beside that of TransformedEnv, over equal plants;
- collecting 8 periods into a buffer of n-step transitions: `Training.collect` beside
  `torchrl.collectors.Collector` and MultiStepTransform, with the same network and exploration;
- the greedy action of one cart: `DrivingPolicy`, traced and compiled, beside the QValueActor, also under
  `torch.compile`;
- a gradient of 512 transitions: `LossGradient`, plain and compiled, beside `backward` and clipping, also of
  the loss under `torch.compile`.

A time is the processor time of the fastest of many calls, in which the rows take turns, with one thread.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from common import option_parser, write_json
from environment import Step, stepper
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform, TransformedEnv
from torchrl.modules import EGreedyModule

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.compilation import LossGradient
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.gymnasium import simulated_environment
from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.evaluation.driving_policy import DrivingPolicy
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.dqn import COLLECTED, LEARNED, Training, n_step_transitions
from cartpole_rl.learning.settings import BufferSettings, LearningSettings, OptimizerSettings
from cartpole_rl.reporting.texts import table

CHUNK, EPSILON, BATCH = 8, 0.1, 512
Pair = dict[str, Step]  # TorchRL's part first


def environment(carts: int) -> CartPoleEnv:
    """The swing-up on `carts` randomized carts."""
    return simulated_environment("swingup", carts, "wide", compiled=True)


def make_agent(env: CartPoleEnv) -> QAgent:
    """An untrained agent of the default settings."""
    signs = env.hardware.observation_settings.mirror_signs
    return QAgent(AgentSettings(**choice("agent/dqn")).at(0.02), signs, len(env.hardware.motors))


def steps(carts: int) -> Pair:
    """One step with resets, under random actions."""
    ours, parts = environment(carts), environment(carts).hardware
    settings = parts.task, parts.observation_settings, parts.reward
    hardware = HardwareTransform(parts.motors.tolist(), *settings, compiled=True)
    stock = TransformedEnv(environment(carts).plant, hardware)
    actions = torch.randint(len(parts.motors), (16, carts))
    return {
        "TransformedEnv, step": stepper(stock, stock.reset(), actions),
        "CartPoleEnv, step": stepper(ours, ours.reset(), actions),
    }


def make_training(carts: int) -> Training:
    """A training of the default settings that explores with EPSILON from the start."""
    env = environment(carts)
    epsilon = {"warmup_transitions": 0, "epsilon": (EPSILON, EPSILON)}
    learning = choice("learning/fast") | epsilon | {"carts": carts, "chunk": CHUNK}
    buffer, optimizer = choice("buffer/prioritized"), choice("optimizer/adam")
    settings = LearningSettings(**learning).at(0.02), BufferSettings(**buffer), OptimizerSettings(**optimizer)
    return Training(*settings, make_agent(env), env, list, None, seed=0)  # type: ignore[arg-type]


def collections(training: Training) -> Pair:
    """A chunk of CHUNK periods, added to a buffer as n-step transitions."""
    carts, n = training.settings.carts, training.settings.steps
    env = environment(carts)
    explore = EGreedyModule(env.action_spec_unbatched, eps_init=EPSILON, eps_end=EPSILON)
    policy = TensorDictSequential(training.agent.actor, explore)
    stock = iter(Collector(env, policy, frames_per_batch=CHUNK * carts))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(training.buffer_settings.size, ndim=2))
    buffer.append_transform(MultiStepTransform(n, training.agent.settings.discount, done_keys=[]))
    return {
        "TorchRL's collector": lambda: buffer.extend(next(stock).select(*COLLECTED)),
        "Training.collect": training.collect,
    }


def choices(agent: QAgent, size: int) -> Pair:
    """The greedy action of one cart for an observation of `size` numbers."""
    policy = agent.greedy_policy()
    present = TensorDict({"observation": torch.randn(1, size)}, [1])
    ways: dict[str, Callable[[TensorDict], Any]] = {
        "QValueActor": policy,
        "QValueActor, torch.compile": torch.compile(policy),
        "DrivingPolicy, traced": DrivingPolicy(policy),
        "DrivingPolicy": DrivingPolicy(policy, compiled=True),
    }
    return {name: partial(torch.no_grad()(way), present) for name, way in ways.items()}


def gradients(training: Training, chunk: TensorDict) -> Pair:
    """The clipped gradient of the loss of BATCH transitions."""
    loss, max_norm = training.agent.loss, training.optimizer_settings.max_grad_norm
    batch, weights = n_step_transitions(chunk, 5, 0.99)[:BATCH], list(training.agent.loss.parameters())

    def stock(function: Any) -> None:
        loss.zero_grad()
        function(batch)["loss"].backward()
        nn.utils.clip_grad_norm_(weights, max_norm)

    plain = LossGradient(loss, LEARNED, max_norm)
    columns = plain.columns(batch)
    return {
        "loss.backward": partial(stock, loss),
        "loss.backward, torch.compile": partial(stock, torch.compile(loss)),
        "LossGradient, not compiled": partial(plain, columns),
        "LossGradient": partial(LossGradient(loss, LEARNED, max_norm, compiled=True), columns),
    }


def seconds(call: Step) -> float:
    """Processor time of one call, after one that fills the caches."""
    call()
    started = time.thread_time()
    call()
    return time.thread_time() - started


def measure(carts: int, budget: float) -> list[dict[str, Any]]:
    """Return the milliseconds per call of each variant, and its speed-up over TorchRL."""
    training = make_training(carts)
    chunk = training.collect()
    pairs = [
        steps(carts),
        collections(training),
        choices(training.agent, chunk["observation"].shape[-1]),
        gradients(training, chunk),
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
    parser = option_parser(__doc__)
    parser.add_argument("--carts", type=int, default=1024, help="simulated in parallel (default: 1024)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of rounds (default: 60)")
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    results = measure(options.carts, options.seconds)
    print(table(results, {"name": "", "ms": "ms per call", "ratio": "speed-up", "to": "as"}))
    write_json(options.json, results)


if __name__ == "__main__":
    main()
