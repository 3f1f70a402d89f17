"""Experiments on a cart: motor values that make its parameters observable.

An experiment is a sequence of `moves`. Only motor values and encoder positions go in and out, so that any
plant can be used. A guard keeps the cart clear of the track's ends: it brakes, whatever the experiment.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from cartpole_rl.identification.moves import (
    Moves,
    Observed,
    Task,
    and_stop,
    experiment_guard,
    go_to,
    guarded,
    hold,
    push,
    until_stopped,
)
from cartpole_rl.plants.measured import measured_part
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Encoders
from cartpole_rl.scheduling import no_garbage_collection
from cartpole_rl.tasks.episode import Ending, Episode

BROKEN_AWAY = 0.002  # m
RIGHT, LEFT = 1, -1


class Experiment(NamedTuple):
    """A named sequence of moves; they return the breakaway motor value if they measure it."""

    name: str
    shows: str  # the parameters, in words
    moves: Callable[[Task], Moves]


def ramps(task: Task) -> Moves:
    """Raise the motor value to each side until the cart breaks away; return a value that always moves it."""
    needed = 0
    yield from hold(0, 0.6, task)  # the pole at rest shows its zero
    for side in 3 * (RIGHT, LEFT):
        yield from go_to(-side * 0.08, task)
        yield from hold(0, 0.4, task)
        start = now = yield 0
        size = task.least(20)
        while abs(now.x - start.x) < BROKEN_AWAY and size < LARGEST_MOTOR:
            size += 1
            now = yield side * size
        needed = max(needed, size)
    yield from hold(0, 0.2, task)
    return needed


def free_swing(task: Task, swing: float = 1.6, seconds: float = 24.0) -> Moves:
    """Swing the pole up to `swing` rad by the cart's own moves, then let it swing, `seconds` s."""
    now = yield 0
    for _ in range(task.periods(15)):
        if abs(math.remainder(now.theta - math.pi, math.tau)) > swing and abs(now.theta_dot) < 2:
            break
        side = -np.sign(now.theta_dot * np.cos(now.theta)) or RIGHT
        now = yield round(side * task.moving(50) - task.more(120) * now.x)
    yield from hold(0, seconds, task)
    return None


def coast(task: Task) -> Moves:
    """Push the cart to each side, weakly and strongly, and let it coast."""
    for more in (20, 50, 90, 140):
        for side in (RIGHT, LEFT):
            yield from go_to(-side * task.side, task)
            yield from push(side * task.moving(more), 0.9, task)
            yield from until_stopped(0, side, task)
    return None


def levels(task: Task) -> Moves:
    """Hold small motor values on a moving cart: the force near the dead-band is not observable at rest."""
    for size in (40, 50, 55, 60, 65, 70, 80, 95):
        for side in (RIGHT, LEFT):
            yield from go_to(-side * task.side, task)
            yield from push(side * task.moving(110), 0.5, task)
            yield from until_stopped(side * task.least(size), side, task)
    return None


def square(task: Task) -> Moves:
    """Reverse the force at regular intervals, which makes the delay observable."""
    for more in (50, 100):
        yield from go_to(0.0, task)
        for half in (0.1, 0.14, 0.2):
            for turn in range(14):
                side = RIGHT if turn % 2 == 0 else LEFT
                yield from hold(side * task.moving(more), half / 2 if turn == 0 else half, task)
    return None


def excite(task: Task, seconds: float = 60.0) -> Moves:
    """Apply random motor values for random times, so that cart and pole cover their range of motion."""
    left = task.periods(seconds)
    while left > 0:
        size = int(task.random.integers(task.least(50), LARGEST_MOTOR + 1))
        periods = int(task.random.integers(2, 18))
        side = RIGHT if task.random.random() < 0.5 else LEFT
        for _ in range(min(left, periods)):
            yield side * size
        left -= periods
    return None


EXPERIMENTS = (
    Experiment("ramps", "where the cart breaks away", ramps),
    Experiment("swing", "the pole's period and what damps it", free_swing),
    Experiment("coast", "the cart's friction", coast),
    Experiment("levels", "the force of small motor values", levels),
    Experiment("square", "latency and lag", square),
    Experiment("excite", "everything at once", excite),
    Experiment("held_out", "nothing: held out to judge the fit", partial(excite, seconds=40.0)),
)
HELD_OUT = "held_out"


def conduct(
    plant: Plant, period: float, seed: int = 0, experiments: tuple[Experiment, ...] = EXPERIMENTS
) -> Iterator[tuple[Experiment, Episode]]:
    """Yield each experiment with its recording, on a plant of one cart; not one without a control period.

    The cart stands, with the motor at 0, whenever a recording is yielded: nothing controls it while a file is
    written. The next experiment continues from there; after an ending by the plant it starts with a reset.
    """
    task = Task.of(period, np.random.default_rng(seed), plant.hardware)
    present, ended = plant.reset_one(), False
    for number, experiment in enumerate(experiments):
        with no_garbage_collection():
            if number and not ended:
                present = plant.step_one(0)  # a new frame: the last one is as old as the writing took
                ended = present.ends
            if ended:
                present = plant.reset_one()
            recorded, present, breakaway = run(plant, present, and_stop(experiment.moves(task), task), task)
        task = task._replace(breakaway=breakaway or task.breakaway)
        ended = recorded.ended_by != Ending.TIME
        if number + 1 == len(experiments):
            plant.halt()
        if recorded.steps:
            yield experiment, recorded


def run(
    plant: Plant, present: PlantOutput[Numbers], moves: Moves, task: Task
) -> tuple[Episode, PlantOutput[Numbers], int | None]:
    """Make the moves from the frame `present` on; return the recording, the last frame, and their result.

    The recording ends where a count froze or jumped. The guard of `task` brakes the cart where the moves do
    not. The motor is at 0 at the end, whatever the moves or the guard requested last.
    """
    counts, gaps, motors, ended = [present.counts], [*present.dt], [], str(Ending.TIME)
    requested, breakaway = next(moves), None
    guard, encoders = experiment_guard(task.period, task.hardware), plant.hardware.encoders
    while True:
        now = observed(counts, gaps, encoders)
        motor = guarded(requested, now.x, now.x_dot, guard, task.track_end)
        present = plant.step_one(motor)
        motors.append(plant.drove(motor))
        counts.append(present.counts)
        gaps += present.dt
        if present.ends:
            ended = str(plant.ended_by or Ending.TRACK)
            break
        try:
            requested = moves.send(observed(counts, gaps, encoders))
        except StopIteration as end:
            breakaway = end.value
            present = plant.step_one(0) if motors[-1] else present
            break
    recorded = recording(np.array(counts), np.array(gaps[1:]), np.array(motors), ended, encoders)
    return measured_part(recorded, plant.fault, plant.hardware), present, breakaway


def observed(counts: list[Numbers], gaps: list[float], encoders: Encoders) -> Observed:
    """Return the newest positions, and speeds from the two newest."""
    (x_before, theta_before), (x, theta) = counts[-2:] if len(counts) > 1 else (counts[0], counts[0])
    return Observed(
        x * encoders.metres,
        (x - x_before) * encoders.metres / gaps[-1],
        theta * encoders.radians,
        (theta - theta_before) * encoders.radians / gaps[-1],
    )


def recording(
    counts: np.ndarray, gaps: np.ndarray, motors: np.ndarray, ended_by: str, encoders: Encoders
) -> Episode:
    """Return an episode without a task, with scores of 0."""
    positions = counts * np.array(encoders.resolution)
    speeds = np.vstack((np.zeros((1, 2)), np.diff(positions, axis=0) / gaps[:, None]))
    nothing = np.zeros(len(motors))
    return Episode(
        time=np.concatenate((np.zeros(1), np.cumsum(gaps))),
        x=positions[:, 0],
        x_dot=speeds[:, 0],
        theta=positions[:, 1],
        theta_dot=speeds[:, 1],
        counts=counts.astype(np.int64),
        motor=motors.astype(np.int64),
        score=nothing,
        score_upright=nothing,
        reward=nothing,
        ended_by=ended_by,
        encoders=encoders,
    )
