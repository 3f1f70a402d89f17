#!/usr/bin/env python
"""How fast is the simulated environment, beside Gymnasium's CartPole and TorchRL's PendulumEnv?

    scripts/bench/environment.py --threads 1 2 --seconds 30 --json environment.json

*Dynamics*: friction, force curve, latency, motor lag, score (6.2) and reset, compiled, on 8192 carts, with
one control period or several in one call. The peer is Gymnasium's CartPole vector entry point, which has a
constant force, no friction and reward 1. Actions and start states are drawn in advance. Substeps are
integration steps in a period: Gymnasium takes 1, training takes 4.

*Environment*: everything that training steps through, on 4096 carts: encoders, delays, the hardware
transform, randomization=wide, reset of single carts. The peer is TorchRL's PendulumEnv, which has none of
that and never ends. Both are measured with `step_and_maybe_reset`, with actions drawn in advance, and with
`rollout` over 32 steps, which draws the actions and stacks the results.

A speed is that of the fastest of many rounds of 10 ms, in which the rows take turns: other work on the
machine slows single rounds, not the fastest. The first call of a round, which fills the caches, is not
counted. Before the measurement every row runs until the ends of its episodes are spread over time.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from common import option_parser, write_json
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, PendulumEnv

from cartpole_rl.compilation import Compiled
from cartpole_rl.envs.gymnasium import simulated_environment
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.randomizer import draw_start
from cartpole_rl.reporting.texts import table
from cartpole_rl.tasks.features import Measured
from cartpole_rl.tasks.rewards import score

PERIOD, TIME_LIMIT = 0.02, 500  # s; periods
WIDE, WHOLE = 8192, 4096  # carts of the dynamics and of the whole environment
ROLLOUT = 32  # steps
CARTPOLE = "Gymnasium CartPole"
PENDULUM_STEP, PENDULUM_ROLLOUT = "PendulumEnv, step", "PendulumEnv, rollout"
MIXING = 300  # periods until the ends of the carts' episodes are spread over time
ROUND = 0.01  # s
Step = Callable[[], object]


class Row(NamedTuple):
    """One line of the table: a step function and the row with which it is compared."""

    name: str
    carts: int
    periods: int  # in one call
    step: Step
    peer: str  # name of that row
    compile_seconds: float


# the dynamics


class Inputs(NamedTuple):
    """The inputs of one call, drawn in advance."""

    table: Tensor  # [P, N] parameters
    motors: Tensor  # [K, N] motor value in each period
    starts: Tensor  # [4, N] start states of the episodes that begin in this call


class Carts(NamedTuple):
    """The state kept from one call to the next, [N] each."""

    x: Tensor
    x_dot: Tensor
    theta: Tensor
    theta_dot: Tensor
    force: Tensor
    motor: Tensor  # in the previous period
    steps: Tensor  # since the start of the episode
    score: Tensor  # sum over the periods of the last call


def run_dynamics(carts: Carts, inputs: Inputs, *, substeps: int) -> Carts:
    """Run K control periods of N carts; score each and reset the carts whose episodes ended."""
    parameters = CartParameters(inputs.table)
    state, force, motor, steps, total = State(*carts[:4]), *carts[4:7], torch.zeros_like(carts.score)
    start = State(*inputs.starts.unbind(0))
    for given in inputs.motors.unbind(0):
        drive = Drive(force, (given, motor))
        state, drive = run_period(state, drive, parameters.latency, parameters, Models(), PERIOD, substeps)
        total = total + score(Measured(*state), x_max=0.38)
        steps = steps + 1
        ended = (state.x.abs() > parameters.track_half_length) | (steps >= TIME_LIMIT)
        again = torch.where(ended, 1.0, 0.0)
        state = State(*(torch.where(again > 0, new, old) for new, old in zip(start, state, strict=True)))
        force, motor, steps = ((1 - again) * value for value in (drive.force, given, steps))
    return Carts(*state, force, motor, steps, total)


def dynamics(carts: int, periods: int, substeps: int) -> Row:
    """Return the row of our dynamics."""
    plant = simulated_environment("swingup", carts, "wide").plant
    generator = torch.Generator().manual_seed(0)
    table = plant.randomizer.draw(carts, generator)
    draws = [
        Inputs(
            table,
            50.0 * torch.randint(-5, 6, (periods, carts), generator=generator),
            draw_start(carts, plant.start, generator).T.contiguous(),
        )
        for _ in range(4)
    ]
    run = Compiled(partial(run_dynamics, substeps=substeps))
    state = Carts(*draws[0].starts, *torch.zeros(4, carts))
    calls = 0

    def step() -> None:
        nonlocal state, calls
        state = run(state, draws[calls % len(draws)])
        calls += 1

    fused = f"{periods} periods per call" if periods > 1 else "1 period per call"
    name = f"dynamics, {fused}, {substeps} substep{'s' if substeps > 1 else ''}"
    return Row(name, carts, periods, step, CARTPOLE, seconds(step))


def cartpole(carts: int) -> Row:
    """Return the row of Gymnasium's CartPole."""
    env = gymnasium.make_vec("CartPole-v1", num_envs=carts, vectorization_mode="vector_entry_point")
    env.reset(seed=0)
    actions = np.random.default_rng(0).integers(2, size=(16, carts))
    calls = iter(range(10**9))
    return Row(CARTPOLE, carts, 1, lambda: env.step(actions[next(calls) % 16]), CARTPOLE, 0.0)


# the environment


def stepper(env: EnvBase, present: TensorDictBase, actions: Tensor) -> Step:
    """Return a function that steps from `present`, with resets, cycling through `actions` [K, N, ...]."""
    calls = 0

    @torch.no_grad()
    def step() -> TensorDictBase:
        nonlocal present, calls
        present["action"] = actions[calls % len(actions)]
        transition, present = env.step_and_maybe_reset(present)
        calls += 1
        return transition

    return step


def environments(carts: int) -> list[Row]:
    """Return the rows of our environment."""
    fast, plain = (simulated_environment("swingup", carts, "wide", each) for each in (True, False))
    actions = torch.randint(len(plain.hardware.motors), (16, carts))
    step, plain_step = (stepper(env, env.reset(), actions) for env in (fast, plain))
    rollout = partial(fast.rollout, ROLLOUT, break_when_any_done=False)
    return [
        Row("environment, step", carts, 1, step, PENDULUM_STEP, seconds(step)),
        Row("environment, rollout", carts, ROLLOUT, rollout, PENDULUM_ROLLOUT, 0.0),
        Row("environment, step, not compiled", carts, 1, plain_step, PENDULUM_STEP, 0.0),
    ]


def pendulums(carts: int) -> list[Row]:
    """Return the rows of TorchRL's pendulum."""
    env = PendulumEnv()
    first = env.reset(env.gen_params(batch_size=[carts]), set_state=False)
    step = stepper(env, first.clone(), 4 * torch.rand(16, carts, 1) - 2)

    def rollout() -> TensorDictBase:
        return env.rollout(ROLLOUT, tensordict=first.clone(), auto_reset=False, break_when_any_done=False)

    return [
        Row(PENDULUM_STEP, carts, 1, step, PENDULUM_STEP, 0.0),
        Row(PENDULUM_ROLLOUT, carts, ROLLOUT, rollout, PENDULUM_ROLLOUT, 0.0),
    ]


# measuring


def seconds(step: Step) -> float:
    """Return the seconds of one call."""
    started = time.perf_counter()
    step()
    return time.perf_counter() - started


def seconds_a_call(step: Step) -> float:
    """Return the mean seconds of the calls in a round of ROUND s, without the first call."""
    step()
    calls, started, passed = 0, time.perf_counter(), 0.0
    while passed < ROUND:
        step()
        calls, passed = calls + 1, time.perf_counter() - started
    return passed / calls


def fastest(rows: list[Row], budget: float) -> dict[str, float]:
    """Return cart periods per second by row name, from rounds over `budget` s."""
    best = dict.fromkeys((row.name for row in rows), np.inf)
    ends = time.perf_counter() + budget
    while time.perf_counter() < ends or np.inf in best.values():
        for row in rows:
            best[row.name] = min(best[row.name], seconds_a_call(row.step))
    return {row.name: row.carts * row.periods / best[row.name] for row in rows}


def measure(threads: int, budget: float) -> list[dict[str, Any]]:
    """Measure all rows with `threads` torch threads; Gymnasium's NumPy uses one."""
    torch.set_num_threads(threads)
    rows = [cartpole(WIDE), *(dynamics(WIDE, *each) for each in ((1, 1), (1, 4), (8, 1)))]
    rows += [*pendulums(WHOLE), *environments(WHOLE)]
    for row in rows:
        for _ in range(MIXING // row.periods):
            row.step()
    speed = fastest(rows, budget)
    return [
        {
            "name": row.name,
            "threads": threads,
            "carts": row.carts,
            "steps_per_second": speed[row.name],
            "peer": row.peer,
            "ratio": speed[row.name] / speed[row.peer],
            "compile_seconds": row.compile_seconds,
        }
        for row in rows
    ]


def show(results: list[dict[str, Any]]) -> str:
    """Return the table of the results."""
    lines = [{**result, "millions": result["steps_per_second"] / 1e6} for result in results]
    columns = {
        "name": "",
        "carts": "carts",
        "threads": "threads",
        "millions": "million steps/s",
        "ratio": "ratio",
        "peer": "compared with",
        "compile_seconds": "first call, s",
    }
    return table(lines, columns)


def main() -> None:
    """Measure, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="torch threads (1 2)")
    parser.add_argument(
        "--seconds", type=float, default=30.0, help="of measurement for each number of threads (30)"
    )
    options = parser.parse_args()
    results = [row for threads in options.threads for row in measure(threads, options.seconds)]
    print(show(results))
    write_json(options.json, results)


if __name__ == "__main__":
    main()
