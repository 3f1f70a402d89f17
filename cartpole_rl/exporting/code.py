"""Parts of all exported code: templates, and the perception that drives a cart as graphs."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from cartpole_rl import drawing
from cartpole_rl.compilation import Trace, trace
from cartpole_rl.envs.perception import Percept, Previous, perceive, perceive_first
from cartpole_rl.envs.settings import CartPoleSettings, TrackGuard
from cartpole_rl.plants.specs import PlantOutput
from cartpole_rl.tasks.features import LENGTH_SCALE

TEMPLATES = Path(__file__).parent / "templates"
NUMBER = torch.zeros(1, 1)
COUNT = torch.zeros(1, 1, dtype=torch.int64)
COUNTS = torch.zeros(2, 1, dtype=torch.int64)
FLAG = torch.zeros(1, 1, dtype=torch.bool)
NO_SPEEDS = torch.zeros(0, 1)  # rewards and scores alone need them


def filled(template: str, values: Mapping[str, object]) -> str:
    """Return the content of a template with `values` in place of @@name@@."""
    return drawing.filled(TEMPLATES / template, values)


class Graph(NamedTuple):
    """A traced function, and examples of its inputs by name."""

    trace: Trace
    inputs: Mapping[str, Tensor]

    @classmethod
    def of(cls, function: Callable[..., tuple[Tensor, ...]], *examples: Any) -> "Graph":
        """Trace a `function` of named tuples of tensors."""
        return cls(
            trace(function, examples),
            {name: part for example in examples for name, part in example._asdict().items()},
        )


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

    @classmethod
    def of(cls, percept: Percept[Tensor]) -> "DrivingPercept":
        """Return the part of a percept that drives a cart."""
        return cls(percept.state, percept.past, percept.observation, percept.guard)


def perception(settings: CartPoleSettings, guard: TrackGuard | None) -> tuple[Graph, Graph]:
    """Return the perception of a first and of a later period, with the track guard `guard`."""
    observation = settings.observation
    encoders = settings.hardware.encoders
    perceive_start = partial(perceive_first, settings=observation, guard=guard, encoders=encoders)
    task = settings.task.at(settings.control_period)
    perceive_next = partial(
        perceive, settings=observation, task=task, rewards=settings.reward, guard=guard, encoders=encoders
    )

    def scaled(length: Tensor) -> Tensor:
        return length[: int(observation.pole_length)] / LENGTH_SCALE

    def start(first: First) -> DrivingPercept:
        output = PlantOutput(first.counts, NUMBER, COUNT, FLAG, FLAG)
        return DrivingPercept.of(perceive_start(output, scaled(first.pole_length), first.track_end))

    def advance(later: Later) -> DrivingPercept:
        remembered = later.last_counts, later.state, later.past, NO_SPEEDS, COUNT, later.motor
        previous = Previous(*remembered, scaled(later.pole_length), later.track_end)
        output = PlantOutput(later.counts, later.dt, COUNT, FLAG, FLAG)
        return DrivingPercept.of(perceive_next(previous, output))

    past = NUMBER.repeat(observation.past_size, 1)
    later = Later(COUNTS, NUMBER, COUNTS, NUMBER.repeat(4, 1), past, COUNT, NUMBER, NUMBER)
    return Graph.of(start, First(COUNTS, NUMBER, NUMBER)), Graph.of(advance, later)
