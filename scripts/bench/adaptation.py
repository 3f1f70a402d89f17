#!/usr/bin/env python
"""How much could an agent gain by adapting to its cart? The ceiling: it is given the cart's numbers.

    scripts/bench/adaptation.py --seeds 3 --jobs 2 --json adaptation.json

Trains agents with the same seeds twice, in simulation: a blind one with the settings of `cartpole-train`, and
an informed one that also observes every drawn parameter of its cart, scaled to -1 to 1 over its range. Each
pair is trained and judged on `randomization=wide` with each range extended on both sides by a share of its
width (`--wider`). Scores are means over the same thousand drawn carts. The ratio is the blind agent's score
divided by the informed agent's: 1 means that knowing the cart gains nothing.

The track guard is `guard=fitted`; further words are overrides of cartpole-train. The JSON file is written
after each training. If it exists, the trainings that it holds are not repeated.
"""

import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from common import (
    LOST_SCORE,
    option_parser,
    overrides_of,
    positive_int,
    print_table,
    processes,
    read_json,
    share,
    write_json,
)
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from truths import widened

from cartpole_rl.choices import choice
from cartpole_rl.envs.build import simulated_env, with_fitted_guard
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.learning.dqn import Monitor, Training
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.reporting.texts import Cell
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.settings import evaluation_seed
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.settings import StartSettings
from cartpole_rl.workflows.config import TrainConfig, load_settings

WIDTHS = (0.0, 1 / 3, 2 / 3)
DRAWN_CARTS, WATCHED_CARTS = 1000, 10  # carts that judge an agent at the end, and during training


class Job(NamedTuple):
    """One training: the share by which the ranges are wider, the seed, and if the agent is informed."""

    wider: float
    seed: int
    informed: bool


class InformedTransform(HardwareTransform):
    """A hardware transform that appends the drawn parameters of each cart to its observation.

    `cart` are the plant's parameters, which change in place when carts reset.
    """

    def __init__(self, config: TrainConfig, cart: CartParameters) -> None:
        motors, observation, period = config.actions.motors, config.observation, config.control_period
        task, reward = config.task.at(period), config.reward.at(period)
        super().__init__(motors, task, observation, reward, config.guard.active, config.compile)
        self.cart, self.names = cart, list(config.ranges)
        nominal = config.nominal_with(config.pole.nominal)
        limits, logarithmic = [], []
        for name, line in config.ranges.items():
            scale = nominal[name] if line.scales_nominal else 1.0
            logarithmic.append(line.distribution == "log_uniform")
            ends = [scale * end for end in line.limits()]
            limits.append([math.log(end) for end in ends] if logarithmic[-1] else ends)
        self.register_buffer("low_high", torch.tensor(limits))
        self.register_buffer("logarithmic", torch.tensor(logarithmic))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the keys of the transform, with the longer observation."""
        spec = super().transform_observation_spec(observation_spec)
        size = self.observation_settings.size + len(self.names)
        spec["observation"] = Unbounded((spec.shape[0], size), dtype=torch.float32, device=spec.device)
        return spec

    def reset_rows(self, first: TensorDictBase, rows: Tensor | None = None) -> TensorDictBase:
        """Add state and observation to the first frames of the carts `rows` [R]; None means all carts."""
        return self._informed(super().reset_rows(first, rows), rows)

    def perceive(
        self, current: TensorDictBase, command: TensorDictBase, next_frame: TensorDictBase
    ) -> TensorDictBase:
        """Add state, observation and reward to the frames after a `command`."""
        return self._informed(super().perceive(current, command, next_frame))

    def _informed(self, frame: TensorDictBase, rows: Tensor | None = None) -> TensorDictBase:
        known = self._scaled_parameters()
        known = known if rows is None else known[rows]
        return frame.set("observation", torch.cat((frame.get("observation"), known), 1))

    def _scaled_parameters(self) -> Tensor:
        """Return the parameters in force, [N, R], -1 to 1 over their ranges."""
        values = torch.stack([getattr(self.cart, name) for name in self.names], 1)
        values = torch.where(self.logarithmic, values.clamp(min=1e-12).log(), values)
        low, high = self.low_high.unbind(1)
        return 2 * (values - low) / (high - low) - 1


def wider_ranges(extra: float) -> dict[str, Range]:
    """Return the ranges of randomization=wide, extended by the share `extra` where that is possible."""
    nominal = {**choice("cart/ip02"), **choice("pole/medium")["choices"]["medium"]}
    return {
        name: wider_range(name, Range(**line), extra, nominal[name])
        for name, line in choice("randomization/wide").items()
    }


def wider_range(name: str, line: Range, extra: float, nominal: float) -> Range:
    """Return `line` extended on the axis on which it is uniform, but not to impossible values below it."""
    logarithmic = line.distribution == "log_uniform"
    low, high = line.limits()
    if logarithmic:
        low, high = map(math.exp, widened((math.log(low), math.log(high)), extra))
    else:
        low, high = widened((low, high), extra)
    if not PARAMETERS[name].bound.holds(low * (nominal if line.scales_nominal else 1.0)):
        low = line.limits()[0]
    kind = "factor" if line.scales_nominal else "absolute"
    return Range.model_validate({"distribution": line.distribution, kind: (low, high)})


def trained_and_judged(job: Job, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Train one agent and return its figures on drawn carts."""
    seed_everything(job.seed)
    config = load_settings(TrainConfig, {"guard": "fitted", "seed": job.seed, **overrides})
    config = with_fitted_guard(config.model_copy(update={"randomization": wider_ranges(job.wider)}))
    signs, started = config.observation.mirror_signs, time.perf_counter()
    if job.informed:
        signs = signs + [-1 if PARAMETERS[name].mirrored else 1 for name in config.ranges]
    agent = QAgent(
        config.agent.at(config.control_period), signs, len(config.actions.motors), config.observation.frames
    )
    env = make_env(config, job, config.learning.carts, config.task.start, job.seed)
    judge = partial(judged, config, job, agent)
    learning = config.learning.at(config.control_period)
    arguments = learning, config.buffer, config.optimizer, agent, env, partial(judge, WATCHED_CARTS)
    Training(*arguments, Monitor(), job.seed, config.compile).run()
    scores = np.array([episode.score.sum() for episode in judge(DRAWN_CARTS)])
    return {
        **job._asdict(),
        "overrides": dict(overrides),
        "score": float(scores.mean()),
        "lost_share": float((scores < LOST_SCORE).mean()),
        "seconds": round(time.perf_counter() - started, 1),
    }


def judged(config: TrainConfig, job: Job, agent: QAgent, carts: int) -> list[Episode]:
    """Return one episode of the greedy policy on each of `carts` drawn carts, the same ones at every call."""
    env = make_env(config, job, carts, config.task.evaluation_start, evaluation_seed(1))
    return run_batch(env, agent.greedy_policy())


def make_env(config: TrainConfig, job: Job, carts: int, start: StartSettings, seed: int) -> CartPoleEnv:
    """Return an environment over `carts` simulated carts, with an InformedTransform if the job says so."""
    compiled = config.compile and carts == config.learning.carts
    env = simulated_env(config, config.plant, carts, start, seed, compiled)
    if not job.informed:
        return env
    plant = env.plant
    assert isinstance(plant, SimulatedPlant)
    return CartPoleEnv(plant, InformedTransform(config, plant.parameters))


def width_row(wider: float, results: Sequence[Mapping[str, Any]]) -> dict[str, Cell]:
    """Return the table row of one width of the ranges, from its finished trainings."""
    row: dict[str, Cell] = {"wider": f"{wider:.3f}"}
    means = {}
    for informed, name in ((False, "blind"), (True, "informed")):
        own = [each for each in results if each["informed"] is informed]
        means[name] = float(np.mean([each["score"] for each in own]))
        lost = float(np.mean([each["lost_share"] for each in own]))
        row |= {f"{name} score": f"{means[name]:.0f}", f"{name} lost": lost}
    return row | {"ratio": means["blind"] / means["informed"], "seeds": len(results) // 2}


def main() -> None:
    """Train every pair, print a table and write the figures."""
    parser = option_parser(__doc__)
    parser.add_argument("--seeds", type=positive_int, default=3, help="pairs of agents of each width (3)")
    parser.add_argument(
        "--wider",
        type=share,
        nargs="+",
        default=WIDTHS,
        metavar="SHARE",
        help="(0 and a third and two thirds)",
    )
    parser.add_argument("--jobs", type=positive_int, default=1, help="trainings at the same time (1)")
    options, words = parser.parse_known_args()
    overrides = overrides_of(words)
    known = read_json(options.json) if options.json and options.json.exists() else []
    if any(each.get("overrides", {}) != overrides for each in known):
        raise SystemExit(f"{options.json} was made with other overrides: use those, or another --json file")
    results = {Job(each["wider"], each["seed"], each["informed"]): each for each in known}
    asked = [Job(w, s, i) for w in options.wider for s in range(options.seeds) for i in (False, True)]
    with processes(options.jobs) as pool:
        trainings = [pool.submit(trained_and_judged, job, overrides) for job in asked if job not in results]
        for done in as_completed(trainings):
            figures = done.result()
            results[Job(figures["wider"], figures["seed"], figures["informed"])] = figures
            print(figures, flush=True)
            write_json(options.json, list(results.values()))
    print_table(
        [width_row(wider, [results[job] for job in asked if job.wider == wider]) for wider in options.wider]
    )


if __name__ == "__main__":
    main()
