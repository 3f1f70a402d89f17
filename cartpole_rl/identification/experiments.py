"""Experiments on a cart: motor values that make its parameters observable.

An experiment consists of moves. A move is a generator: it yields the motor value of the next period and is
sent the observation at its end. Only motor values and encoder positions go in and out, so that any plant can
be used. A guard keeps the cart clear of the track's ends: it brakes, whatever the experiment.

The guard brakes a cart that is not known yet, at any control period T. It has the form of a track guard
without a pole (`envs/guard.py`). If it lets a cart run, the next command in force comes T + RESPONSE later.
Until then the cart may gain speed at the rate ACCELERATION, and it already has gained some: the measured
speed is half a period old. A cart of measured speed v that is braked just as hard, a = ACCELERATION,
therefore runs on by

    (v + a T / 2) t + a t^2 / 2 + (v + a g)^2 / (2 a),    t = T + RESPONSE,    g = t + T / 2,

which is the guard's margin + delay v + v^2 / (2 a) with

    margin = a (T t + t^2 + g^2) / 2,    delay = t + g.

ACCELERATION is that of ip02; a is scaled to the cart by the rough numbers of its file. If its brake b is
weaker than a, v^2 is over 2 b, and g^2 a / b and g a / b stand for g^2 and g.
"""

import math
from collections.abc import Callable, Generator, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cartpole_rl.envs.guard import guard_side
from cartpole_rl.envs.settings import LARGEST_MARGIN, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.measured import FROZEN, BlindMotion, measured_part, shortened
from cartpole_rl.plants.specs import Numbers, Plant, PlantOutput
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Encoders, Hardware, nominal_hardware
from cartpole_rl.scheduling import no_garbage_collection
from cartpole_rl.tasks.episode import Ending, Episode

CLEARANCE = 0.0926  # m to the soft limit: what carts overrun that are harder to brake than assumed, and more
LARGEST_CLEARANCE = 0.25  # of the way from the middle to the soft limit, on a short track
BREAKAWAY = 1.2  # times the motor value that just moves the cart by its file; moves most carts
RESPONSE = 0.035  # s, latency and lag of the motor
ACCELERATION = 1 / 0.24  # m/s^2, of ip02
SHORTEST = 0.02  # s: shorter periods have its numbers, since carts have longer latencies than assumed, too
BRAKE = 220  # motor value of the guard

LEAST_REACH = 0.05  # m from the middle: less shows no friction
SIDE = 20 / 27  # share of the guard's reach where a run to the other side starts: 0.2 m at 20 ms
CLOSE, SLOW = 0.02, 0.05  # m, m/s: at the target, and at rest
LONGEST_MOVE = 4.0  # s
STANDING, LONGEST_STOP = 0.005, 3.0  # m/s, s: at the end of an experiment

BROKEN_AWAY = 0.002  # m
SURELY = 1.2  # times the measured breakaway motor value: it moves the cart
GIVEN_UP = 0.5  # s after which a cart that does not move is held by friction
RIGHT, LEFT = 1, -1


class Observed(NamedTuple):
    """The observation at the end of a period."""

    x: float  # m
    x_dot: float  # m/s, a difference
    theta: float  # rad, 0 upright
    theta_dot: float  # rad/s, a difference


Moves = Generator[int, Observed, Any]  # it returns the breakaway motor value if it measures it


class Task(NamedTuple):
    """The conditions of an experiment."""

    period: float  # s, of control
    random: np.random.Generator
    breakaway: int  # motor value that moves the cart from rest
    surely: float  # motor value that moves it if its encoder is not dead
    hardware: Hardware

    @classmethod
    def of(cls, period: float, random: np.random.Generator, hardware: Hardware) -> "Task":
        """Return the conditions before the cart is known."""
        breakaway = min(LARGEST_MOTOR, round(BREAKAWAY * hardware.breakaway_motor))
        return cls(period, random, breakaway, hardware.hard_push, hardware)

    def knowing(self, breakaway: int) -> "Task":
        """Return the conditions once the breakaway motor value is measured."""
        return self._replace(breakaway=breakaway, surely=SURELY * breakaway)

    @property
    def side(self) -> float:
        """The distance from the middle where a run to the other side starts, m."""
        return SIDE * reach(self.period, self.hardware)

    def periods(self, seconds: float) -> int:
        """Return the number of control periods in a time."""
        return round(seconds / self.period)

    def more(self, of_ip02: float) -> float:
        """Return the motor value that accelerates this cart as `of_ip02` does ip02, beyond friction."""
        return of_ip02 * strength(nominal_hardware()) / strength(self.hardware)

    def least(self, of_ip02: int) -> int:
        """Return a motor value about the one that just moves the cart, as `of_ip02` is for ip02."""
        return max(1, round(of_ip02 * self.hardware.breakaway_motor / nominal_hardware().breakaway_motor))

    def moving(self, more: int) -> int:
        """Return a motor value that moves the cart, by `more` than needed; `more` is that of ip02."""
        return min(LARGEST_MOTOR, self.breakaway + round(self.more(more)))


def hold(motor: int, seconds: float, task: Task) -> Moves:
    """Hold one motor value for `seconds` s."""
    for _ in range(task.periods(seconds)):
        yield motor


def push(motor: int, speed: float, task: Task) -> Moves:
    """Hold one motor value until the cart reaches a speed, m/s, or has moved 0.1 m, at most half a second."""
    start = now = yield motor
    for _ in range(task.periods(0.5)):
        if abs(now.x - start.x) > 0.1 or abs(now.x_dot) > speed:
            break
        now = yield motor


def until_stopped(motor: int, side: int, task: Task) -> Moves:
    """Hold one motor value until the cart stops or gets near the end at `side`, then rest briefly."""
    far = task.side + 0.03  # m
    now = yield motor
    for _ in range(task.periods(LONGEST_MOVE)):
        if abs(now.x_dot) < SLOW / 5 or side * now.x > far:
            break
        now = yield motor
    yield from hold(0, 0.2, task)


def go_to(target: float, task: Task) -> Moves:
    """Bring the cart near `target` m, unless friction holds it."""
    start = now = yield 0
    for period in range(task.periods(LONGEST_MOVE)):
        if period > task.periods(GIVEN_UP) and abs(now.x - start.x) < BROKEN_AWAY:
            break
        away = target - now.x
        if abs(away) < CLOSE and abs(now.x_dot) < SLOW:
            break
        wish = np.clip(6 * away, -0.5, 0.5) - now.x_dot  # m/s
        now = yield round(np.sign(wish) * 0.8 * task.breakaway + task.more(250) * wish)
    yield 0


def and_stop(moves: Moves, task: Task) -> Moves:
    """Make the moves, then hold motor 0 until the cart stands; return the result of the moves."""
    breakaway = yield from moves
    for _ in range(task.periods(LONGEST_STOP)):
        now = yield 0
        if abs(now.x_dot) < STANDING:
            break
    return breakaway


def strength(hardware: Hardware) -> float:
    """Return the acceleration of a cart by a motor value of 1 beyond the one that just moves it, m/s^2."""
    return 1 / (hardware.motor_per_newton * hardware.moving_mass)


def track_end(hardware: Hardware, soft_limit: float = math.inf) -> float:
    """Return how far from the middle an experiment may get, m.

    `soft_limit` is that of a cart, m from the middle, where it is known: its track may be shorter than its
    file's.
    """
    soft = min(hardware.half_span - hardware.soft_limit, soft_limit)
    return soft - min(CLEARANCE, LARGEST_CLEARANCE * soft)


def experiment_guard(period: float, hardware: Hardware) -> TrackGuard:
    """Return the numbers of the guard at a control period, s.

    Raises ConfigError for a cart that cannot be braked, or has no room for it on its track.
    """
    given, end = period, track_end(hardware)
    period = max(period, SHORTEST)
    runs_on = period + RESPONSE
    gains = runs_on + period / 2
    full, of_ip02 = (
        strength(each) * (LARGEST_MOTOR - each.breakaway_motor) for each in (hardware, nominal_hardware())
    )
    gain = ACCELERATION * full / of_ip02
    brake = strength(hardware) * (BRAKE - 2 * hardware.motor_offset + hardware.breakaway_motor)
    if brake <= 0:
        raise ConfigError(
            f"cart.motor_offset={hardware.motor_offset:g}: experiments brake with a motor value of {BRAKE}, "
            "which brakes no such cart; give less"
        )
    deceleration = min(gain, brake)
    margin = gain / 2 * (period * runs_on + runs_on**2 + gain / deceleration * gains**2)
    delay = runs_on + gain / deceleration * gains
    if margin > min(LARGEST_MARGIN, end - LEAST_REACH):
        raise ConfigError(
            f"control_period={given:g}: full motor accelerates the cart of cart= by {gain:.1f} m/s^2; to "
            f"brake it takes {margin:.2f} m of the {end:.2f} m to each side; give a shorter period, or "
            "correct motor_per_newton, moving_mass or track_span"
        )
    return TrackGuard(margin=round(margin, 4), delay=delay, deceleration=deceleration)


def reach(period: float, hardware: Hardware) -> float:
    """Return how far from the middle the guard lets a cart at rest be, m."""
    return track_end(hardware) - experiment_guard(period, hardware).margin


def guarded(motor: float, x: float, x_dot: float, guard: TrackGuard, track_end: float) -> int:
    """Return the motor value, or one that brakes if the cart would get beyond `track_end`, m."""
    side = guard_side(x, x_dot, track_end, guard)
    if side and motor * side < BRAKE:
        return int(side) * BRAKE
    return int(np.clip(motor, -LARGEST_MOTOR, LARGEST_MOTOR))


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
        most = min(2 * needed or LARGEST_MOTOR, LARGEST_MOTOR)
        while abs(now.x - start.x) < BROKEN_AWAY and size < most:
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


def coast(task: Task) -> Moves:
    """Push the cart to each side, weakly and strongly, and let it coast."""
    for more in (20, 50, 90, 140):
        for side in (RIGHT, LEFT):
            yield from go_to(-side * task.side, task)
            yield from push(side * task.moving(more), 0.9, task)
            yield from until_stopped(0, side, task)


def levels(task: Task) -> Moves:
    """Hold small motor values on a moving cart: the force near the dead-band is not observable at rest."""
    for size in (40, 50, 55, 60, 65, 70, 80, 95):
        for side in (RIGHT, LEFT):
            yield from go_to(-side * task.side, task)
            yield from push(side * task.moving(110), 0.5, task)
            yield from until_stopped(side * task.least(size), side, task)


def square(task: Task) -> Moves:
    """Reverse the force at regular intervals, which makes the delay observable."""
    for more in (50, 100):
        yield from go_to(0.0, task)
        for half in (0.1, 0.14, 0.2):
            for turn in range(14):
                side = RIGHT if turn % 2 == 0 else LEFT
                yield from hold(side * task.moving(more), half / 2 if turn == 0 else half, task)


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
        task = task.knowing(breakaway) if breakaway else task
        ended = recorded.ended_by != Ending.TIME
        if number + 1 == len(experiments):
            plant.halt()
        if recorded.steps:
            yield experiment, recorded


def run(
    plant: Plant, present: PlantOutput[Numbers], moves: Moves, task: Task
) -> tuple[Episode, PlantOutput[Numbers], int | None]:
    """Make the moves from the frame `present` on; return the recording, the last frame, and their result.

    The recording ends where a count froze or jumped; if the cart's does not show its motion, the moves end as
    well. The guard of `task` brakes the cart where the moves do not. The motor is at 0 at the end, whatever
    the moves or the guard requested last.
    """
    counts, gaps, motors, ended = [present.counts], [*present.dt], [], str(Ending.TIME)
    blind, stands = BlindMotion(task.hardware, task.surely), 0
    requested, breakaway = next(moves), None
    guard, encoders = experiment_guard(task.period, task.hardware), plant.hardware.encoders
    end = track_end(task.hardware, float(plant.track_half_length))
    while True:
        now = observed(counts, gaps, encoders)
        motor = guarded(requested, now.x, now.x_dot, guard, end)
        present = plant.step_one(motor)
        motors.append(plant.drove(motor))
        counts.append(present.counts)
        gaps += present.dt
        if present.ends:
            ended = str(plant.ended_by or Ending.TRACK)
            break
        if blind.is_seen(motors[-1], counts[-1][0], gaps[-1]):
            ended, stands = str(Ending.FAULT), blind.periods
            plant.halt()
            break
        try:
            requested = moves.send(observed(counts, gaps, encoders))
        except StopIteration as result:
            breakaway = result.value
            present = plant.step_one(0) if motor or motors[-1] else present
            break
    recorded = recording(np.array(counts), np.array(gaps[1:]), np.array(motors), ended, encoders)
    if stands:
        measured = shortened(recorded, len(motors) - stands, FROZEN)
    else:
        measured = measured_part(recorded, plant.fault, plant.hardware)
    if measured.left_out:
        plant.distrust()
    return measured, present, breakaway


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
