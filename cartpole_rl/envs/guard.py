"""The track guard: full motor inward where the cart could otherwise not be stopped before the track's end.

It is part of the hardware transform, so that simulation and cart have it alike and an agent learns with it.
It lies above the limits of the cart (soft and hard limit, docs/protocol.md) and below the agent.

A cart at position x with speed v, both positive to the right, is predicted to come to rest, under full motor
to the left, at

    x + margin + delay v + v |v| / (2 deceleration)

Beyond the track's end, the guard replaces the agent's motor value by full motor to the left; likewise on the
left.

The three numbers are fitted to the carts in question. Carts are drawn as in training and put into random
states: a speed, an angle of the pole, and an energy of the pole up to somewhat more than upright. Each has
full motor outward under way, keeps it for one more period, since the guard decides once a period, and then
brakes with full motor inward. Half of them run to the right, half to the left: carts may brake better in one
direction. A share `quantile` of each half stays within some way, which depends on the measured speed. The
guard's way bounds it from above as closely as possible: a linear program in margin, delay and
1 / deceleration. A cart that is braked by its motor's back-EMF runs on in proportion to its speed: its guard
has the deceleration FASTEST.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.envs.settings import LARGEST_MARGIN, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters
from cartpole_rl.plants.simulated import commands_under_way
from cartpole_rl.randomization.randomizer import Draws

Number = TypeVar("Number", float, Tensor)

# The fit
SAMPLES = 65536
SPEEDS = (0.0, 2.2)  # m/s, of the cart at the start; agents of the shipped experiments stay within
BIN = 0.1  # m/s
LEAST_SAMPLES = 500  # in a bin, for its quantile
MOST_ENERGY = 1.3  # of the pole, as a multiple of that of the upright pole at rest, above hanging
BRAKING = 1.2, 5.0  # s, at least and at most; the slowest carts of randomization=wide stop within 1
STOPPED = 0.01  # m/s
FASTEST = 100.0  # m/s^2, the largest deceleration
SUBSTEPS = 4

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


def stopping_distance(x_dot: Number, guard: TrackGuard) -> Number:
    """Return the way to the right, m, that a cart of speed `x_dot` m/s makes under full motor to the left."""
    return guard.margin + guard.delay * x_dot + x_dot * abs(x_dot) / (2 * guard.deceleration)


def guard_side(x: Number, x_dot: Number, track_end: Number | float, guard: TrackGuard) -> Number:
    """Return the direction of the guard's full motor: 1 to the right, -1 to the left, 0 if it is not needed.

    `x` m from the middle of the track, `x_dot` m/s, `track_end` m, all floats or [N].
    """
    too_far_right = x + stopping_distance(x_dot, guard) > track_end
    too_far_left = -x + stopping_distance(-x_dot, guard) > track_end
    return 1 * too_far_left - 1 * too_far_right


def fitted_guard(
    quantile: float, draws: Draws, motors: Sequence[int], models: Models, period: float, track_end: float
) -> TrackGuard:
    """Return the guard that a share `quantile` of the carts of `draws` obeys in time.

    `motors` are the motor values of the agent, `period` is the control period, s, `track_end` is half the
    track, m. Raises ConfigError if full motor does not brake the carts, or so late that they need most of it.
    """
    if not min(motors) < 0 < max(motors):
        raise ConfigError(f"guard: actions.motors={list(motors)} brake in one direction; choose guard=none")
    with one_thread():
        speed, way, rightward = braking_distances(draws, motors, models, period)
    if not np.isfinite(speed).all() or np.isnan(way).any():
        raise ConfigError(
            "guard: simulated carts brake to numbers that are not finite; check cart.*, or guard=none"
        )
    halves = [quantiles(speed[half], way[half], quantile) for half in (rightward, ~rightward)]
    middles, ways = map(np.concatenate, zip(*halves, strict=True))
    if not np.isfinite(ways).all():
        raise ConfigError(
            "guard: full motor does not stop these carts; check masses (kg) and forces (N), choose other "
            "actions, or guard=none"
        )
    margin, delay, curvature = closest_bound(middles, ways)
    largest = min(LARGEST_MARGIN, track_end)
    if round(margin, 4) >= largest:
        raise ConfigError(
            f"guard: even from rest these carts run on by {margin:.3f} m before full motor stops them; this "
            f"margin must be below {largest:g} m: give a shorter control_period, less latency or "
            "smaller motor values, or guard=none"
        )
    return TrackGuard(margin=round(margin, 4), delay=round(delay, 4), deceleration=round(0.5 / curvature, 3))


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread.

    The fit is many short operations: beside other programs several threads take 5 to 30 times as long. A
    process that never started threads can also be forked, as Gymnasium's AsyncVectorEnv does.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def braking_distances(
    draws: Draws, motors: Sequence[int], models: Models, period: float
) -> tuple[Array, Array, Flags]:
    """Return measured speeds, m/s, ways that carts run on, m, and which run to the right, [SAMPLES] each.

    Speeds and ways are positive in the direction of motion. The way of a cart that still runs on after the
    longest time of BRAKING is infinite.
    """
    generator = torch.Generator().manual_seed(0)
    table = draws.draw(SAMPLES, generator)
    cart = CartParameters(table)
    rightward = torch.arange(SAMPLES) % 2 == 0
    side = torch.where(rightward, 1.0, -1.0)
    state = random_states(cart, generator)
    state = state._replace(x_dot=side * state.x_dot)
    commands = commands_under_way(draws.longest_delay(), period)
    right, left = float(max(motors)), float(min(motors))
    outward, inward = torch.where(rightward, right, left), torch.where(rightward, left, right)
    drive = Drive(models.actuator(outward, cart), [outward] * commands)
    before, (state, drive) = state, run_period(state, drive, cart.latency, cart, models, period, SUBSTEPS)
    speed, start, farthest = side * (state.x - before.x) / period, state.x, torch.zeros(SAMPLES)
    runs_on = torch.ones(SAMPLES, dtype=torch.bool)
    least, most = (math.ceil(each / period) for each in BRAKING)
    for step in range(most):
        if step >= least and not runs_on.any():
            break
        drive = Drive(drive.force, [inward if step else outward, *drive.motors[:-1]])
        state, drive = run_period(state, drive, cart.latency, cart, models, period, SUBSTEPS)
        farthest = torch.maximum(farthest, side * (state.x - start))
        runs_on = side * state.x_dot > STOPPED
    farthest[runs_on] = math.inf
    return speed.double().numpy(), farthest.double().numpy(), rightward.numpy()


def random_states(cart: CartParameters, generator: torch.Generator) -> State:
    """Return true states [N] in the middle of the track, with speeds in SPEEDS and a swinging pole."""
    count = len(cart.cart_mass)

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, generator=generator)

    theta = uniform(-math.pi, math.pi)
    stiffness = cart.first_moment * GRAVITY / cart.pivot_inertia  # 1/s^2
    kinetic = stiffness * (uniform(0, 2 * MOST_ENERGY) - 1 - torch.cos(theta))
    theta_dot = (2 * kinetic.clamp(min=0)).sqrt() * uniform(-1, 1).sign()
    return State(torch.zeros(count), uniform(*SPEEDS), theta, theta_dot)


def quantiles(speed: Array, way: Array, quantile: float) -> tuple[Array, Array]:
    """Return the middles of bins of `speed`, m/s, and the quantile of the `way` in each, m."""
    bins = np.floor(speed / BIN).astype(int)
    middles, ways = [], []
    for number in np.unique(bins):
        inside = bins == number
        if inside.sum() >= LEAST_SAMPLES:
            middles.append((number + 0.5) * BIN)
            with np.errstate(invalid="ignore"):  # between two infinite ways
                ways.append(np.quantile(way[inside], quantile))
    return np.array(middles), np.array(ways)


def closest_bound(speed: Array, way: Array) -> tuple[float, float, float]:
    """Return (margin m, delay s, curvature s^2/m) of the least upper bound on `way` that is a guard's."""
    from scipy.optimize import linprog  # slow to import

    terms = np.stack((np.ones_like(speed), speed, speed * np.abs(speed)), 1)
    result = linprog(
        terms.sum(0), A_ub=-terms, b_ub=-way, bounds=[(0, None), (0, None), (0.5 / FASTEST, None)]
    )
    margin, delay, curvature = result.x
    return float(margin), float(delay), float(curvature)
