"""The part of perception that drives a cart: state, memory, observation and track guard, as graphs."""

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from cartpole_rl.compilation import Trace, trace
from cartpole_rl.envs.cart_pole_settings import CartPoleSettings
from cartpole_rl.envs.perception import FirstPercept, Percept, PlantOutput, Previous, perceive, perceive_first
from cartpole_rl.envs.settings import TrackGuard
from cartpole_rl.tasks.features import LENGTH_SCALE

NUMBER = torch.zeros(1, 1)
COUNT = torch.zeros(1, 1, dtype=torch.int64)
COUNTS = torch.zeros(2, 1, dtype=torch.int64)
FLAG = torch.zeros(1, 1, dtype=torch.bool)


class First(NamedTuple):
    """The inputs of a first period."""

    counts: Tensor  # [2, 1] int64
    pole_length: Tensor  # [1, 1] m
    track_end: Tensor  # [1, 1] m


class Later(NamedTuple):
    """The inputs of a later period; `last` is the period before."""

    counts: Tensor  # [2, 1] int64
    dt: Tensor  # [1, 1] s
    last_counts: Tensor  # [2, 1] int64
    state: Tensor  # [4, 1]
    past: Tensor  # [past_size, 1]
    motor: Tensor  # [1, 1] int64
    pole_length: Tensor  # [1, 1] m
    track_end: Tensor  # [1, 1] m


class DrivingPercept(NamedTuple):
    """The results of a period."""

    state: Tensor  # [4, 1]
    past: Tensor  # [past_size, 1]
    observation: Tensor  # [size, 1]
    guard: Tensor  # [1, 1] int64, direction of the track guard's motor value


class PerceptionGraphs(NamedTuple):
    """Both graphs, and examples of their inputs."""

    first: Trace
    first_inputs: First
    later: Trace
    later_inputs: Later


@torch.no_grad()
def perception_graphs(settings: CartPoleSettings, guard: TrackGuard | None) -> PerceptionGraphs:
    """Return the graphs of perception under `settings` with the track guard `guard`."""
    observation = settings.observation
    perceive_start = partial(perceive_first, settings=observation, guard=guard)
    perceive_next = partial(
        perceive, settings=observation, task=settings.task, rewards=settings.reward, guard=guard
    )

    def scaled(length: Tensor) -> Tensor:
        return length[: int(observation.pole_length)] / LENGTH_SCALE

    def start(first: First) -> DrivingPercept:
        return driving_percept(perceive_start(first.counts, scaled(first.pole_length), first.track_end))

    def advance(later: Later) -> DrivingPercept:
        remembered = later.last_counts, later.state, later.past, COUNT, later.motor
        previous = Previous(*remembered, scaled(later.pole_length), later.track_end)
        return driving_percept(perceive_next(previous, PlantOutput(later.counts, later.dt, FLAG, FLAG)))

    past = NUMBER.repeat(observation.past_size, 1)
    first = First(COUNTS, NUMBER, NUMBER)
    later = Later(COUNTS, NUMBER, COUNTS, NUMBER.repeat(4, 1), past, COUNT, NUMBER, NUMBER)
    return PerceptionGraphs(trace(start, (first,)), first, trace(advance, (later,)), later)


def driving_percept(percept: FirstPercept[Tensor] | Percept[Tensor]) -> DrivingPercept:
    """Return the results that drive a cart."""
    return DrivingPercept(percept.state, percept.past, percept.observation, percept.guard)
