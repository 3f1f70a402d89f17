"""The track guard: full motor inward where the cart could otherwise not be stopped before the track's end.

It is part of the hardware transform, so that simulation and cart have it alike and an agent learns with it.
It lies above the limits of the cart (soft and hard limit, docs/protocol.md) and below the agent.

A cart at position x with speed v, both positive to the right, is predicted to come to rest, under full motor
to the left, at

    x + margin + delay v + swing (r + r sin theta) + (1 + mu) V |V| / (2 deceleration)

If that is beyond the track's end, the guard replaces the agent's motor value by full motor to the left;
likewise on the left. If both sides are too near, it does nothing.

Motor and friction brake the centre of mass of cart and pole, whatever the pole does. It is r sin theta to the
right of the cart and moves with V = v + r cos(theta) theta_dot. Here mu is the pole's mass over the cart's,
which is `density` times the pole's length, and r = mu / (1 + mu) times the distance from pivot to the pole's
centre of mass. When the centre of mass rests, the cart is at most r to the right of it, so it runs on by
r + r sin theta more at most; `swing` is the share of that which is reserved.

Margin, delay, swing and deceleration are fitted to the carts in question. Carts are drawn as in training and
put into random states: a speed, an angle of the pole, and an energy of the pole up to somewhat more than
upright. Each has full motor outward under way, keeps it for one more period, since the guard decides once a
period, and then brakes with full motor inward. A quantile regression (Koenker and Bassett, "Regression
quantiles", Econometrica, 1978) finds the four numbers, none negative, with which a share `quantile` of the
carts stays within the way that is predicted from what was measured. It is made for the carts that run to the
right and for those that run to the left, since carts may brake better in one direction; the guard has the
largest margin, delay and swing and the least deceleration. A cart that is braked by its motor's back-EMF runs
on in proportion to its speed: its guard has the deceleration FASTEST.

The guards of older agents have no `pole`: theirs is the formula with the cart's speed alone.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.envs.settings import LARGEST_MARGIN, GuardedPole, TrackGuard
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.dynamics import Drive, State, run_period
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters
from cartpole_rl.plants.simulated import commands_under_way
from cartpole_rl.randomization.randomizer import Draws
from cartpole_rl.tasks.features import Measured

Number = TypeVar("Number", float, Tensor)

# The fit
SAMPLES = 32768
SPEEDS = (0.0, 2.2)  # m/s, of the cart at the start; agents of the shipped experiments stay within
MOST_ENERGY = 1.3  # of the pole, as a multiple of that of the upright pole at rest, above hanging
BRAKING = 1.2, 5.0  # s, at least and at most; the slowest carts of randomization=wide stop within 1
STOPPED = 0.01  # m/s
FASTEST = 100.0  # m/s^2, the largest deceleration
SUBSTEPS = 4


# the rule


class Centre(NamedTuple):
    """Position and velocity of the centre of mass of cart and pole, positive to the right; [N] or floats."""

    mass: Tensor | float  # of cart and pole, over the cart's: 1 + mu
    reach: Tensor | float  # m, its largest distance from the cart: r
    offset: Tensor  # m, from the cart: r sin theta
    speed: Tensor  # m/s: V

    @property
    def braked(self) -> Tensor:
        """The way of the braked centre times twice the deceleration, (m/s)^2: (1 + mu) V |V|."""
        return self.mass * self.speed * self.speed.abs()

    @property
    def mirrored(self) -> "Centre":
        """The same with left and right swapped."""
        return self._replace(offset=-self.offset, speed=-self.speed)


def centre_of_mass(motion: Measured, pole: GuardedPole, length: Tensor | None) -> Centre:
    """Return the centre of mass of carts; `length` [N] m is read where the guard's pole has none."""
    known = length if pole.length is None else pole.length
    assert known is not None
    mass = 1 + pole.density * known
    reach = (mass - 1) / mass * known / 2
    turning = reach * torch.cos(motion.theta) * motion.theta_dot
    return Centre(mass, reach, reach * torch.sin(motion.theta), motion.x_dot + turning)


def stopping_distance(x_dot: Number, guard: TrackGuard, centre: Centre | None = None) -> Number | Tensor:
    """Return the way to the right, m, that a cart of speed `x_dot` m/s makes under full motor to the left.

    `centre` is given where the guard has a pole.
    """
    way = guard.margin + guard.delay * x_dot
    if centre is None:
        return way + x_dot * abs(x_dot) / (2 * guard.deceleration)
    assert guard.pole is not None
    return way + guard.pole.swing * (centre.reach + centre.offset) + centre.braked / (2 * guard.deceleration)


def guard_side(
    x: Number, x_dot: Number, track_end: Number | float, guard: TrackGuard, centre: Centre | None = None
) -> Number | Tensor:
    """Return the direction of the full motor of a single guard, as `guard_direction` does.

    `x` m from the middle of the track, `x_dot` m/s, `track_end` m, all floats or [N]; `centre` as above.
    """
    mirrored = None if centre is None else centre.mirrored
    too_far_right = x + stopping_distance(x_dot, guard, centre) > track_end
    too_far_left = -x + stopping_distance(-x_dot, guard, mirrored) > track_end
    return 1 * too_far_left - 1 * too_far_right


def guard_direction(
    motion: Measured, track_end: Tensor, guard: TrackGuard, length: Tensor | None = None
) -> Tensor:
    """Return the direction of the guard's full motor: 1 to the right, -1 to the left, 0 if it is not needed.

    `track_end` [N] is m from the middle of the track; `length` [N] m is the pole's, if it is observed.
    """

    def side(each: TrackGuard) -> Tensor:
        centre = None if each.pole is None else centre_of_mass(motion, each.pole, length)
        return guard_side(motion.x, motion.x_dot, track_end, each, centre)

    direction, *others = map(side, guard.each)
    for other in others:
        direction = torch.where(direction == 0, other, direction)
    return direction


# the fit


def fitted_guard(
    quantile: float,
    draws: Draws,
    motors: Sequence[int],
    models: Models,
    period: float,
    track_end: float,
    pole: GuardedPole,
) -> TrackGuard:
    """Return the guard that a share `quantile` of the carts of `draws` obeys in time.

    `motors` are the motor values of the agent, `period` is the control period, s, `track_end` is half the
    track, m; the swing of `pole` is fitted. Raises ConfigError if full motor does not brake the carts, or so
    late that they need most of it.
    """
    if not min(motors) < 0 < max(motors):
        raise ConfigError(f"guard: actions.motors={list(motors)} brake in one direction; choose guard=none")
    with one_thread():
        brakings = braking_distances(draws, motors, models, period)
    if not all(each.isfinite().all() for each in brakings.motion) or brakings.way.isnan().any():
        raise ConfigError(
            "guard: simulated carts brake to numbers that are not finite; check cart.*, or guard=none"
        )
    halves = [brakings.rows(half) for half in (brakings.rightward, ~brakings.rightward)]
    if any(half.way.isinf().float().mean() > 1 - quantile for half in halves):
        raise ConfigError(
            "guard: full motor does not stop these carts; check masses (kg) and forces (N), choose other "
            "actions, or guard=none"
        )
    numbers = np.max([least_bound(half, pole, quantile) for half in halves], 0).clip(min=0) + 0.0
    margin, delay, swing, curvature = numbers.tolist()
    pole = pole.model_copy(update={"swing": round(swing, 4)})
    reach = float(torch.as_tensor(centre_of_mass(brakings.motion, pole, brakings.length).reach).max())
    at_rest, margin = margin + swing * reach, round(margin, 4)
    if margin >= LARGEST_MARGIN or at_rest >= track_end:
        way, largest = (at_rest, track_end) if at_rest >= track_end else (margin, LARGEST_MARGIN)
        raise ConfigError(
            f"guard: even from rest these carts run on by {way:.3f} m before full motor stops them; this "
            f"margin must be below {largest:g} m: give a shorter control_period, less latency, "
            "smaller motor values or a smaller guard.quantile, or guard=none"
        )
    deceleration = round(0.5 / max(curvature, 0.5 / FASTEST), 3)
    return TrackGuard(margin=margin, delay=round(delay, 4), deceleration=deceleration, pole=pole)


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


class Brakings(NamedTuple):
    """Carts when they begin to brake, and how far they run on; [N] each."""

    motion: Measured  # as measured; mirrored for a cart that runs to the left
    length: Tensor  # m, of the pole
    rightward: Tensor  # bool: the cart runs to the right
    way: Tensor  # m, in the direction of motion; infinite if it runs on after the longest time of BRAKING

    def rows(self, rows: Tensor) -> "Brakings":
        """Return some of them."""
        motion = Measured(*(each[rows] for each in self.motion))
        return Brakings(motion, self.length[rows], self.rightward[rows], self.way[rows])


def braking_distances(draws: Draws, motors: Sequence[int], models: Models, period: float) -> Brakings:
    """Return SAMPLES brakings of carts in random states."""
    generator = torch.Generator().manual_seed(0)
    cart = CartParameters(draws.draw(SAMPLES, generator))
    rightward = torch.arange(SAMPLES) % 2 == 0
    side = torch.where(rightward, 1.0, -1.0)
    state = random_states(cart, generator)
    state = state._replace(x_dot=side * state.x_dot)
    commands = commands_under_way(draws.longest_delay(), period)
    right, left = float(max(motors)), float(min(motors))
    outward, inward = torch.where(rightward, right, left), torch.where(rightward, left, right)
    drive = Drive(models.actuator(outward, cart), [outward] * commands)
    before, (state, drive) = state, run_period(state, drive, cart.latency, cart, models, period, SUBSTEPS)
    speeds = (state.x - before.x) / period, (state.theta - before.theta) / period
    motion = Measured(torch.zeros(SAMPLES), side * speeds[0], side * state.theta, side * speeds[1])
    start, farthest = state.x, torch.zeros(SAMPLES)
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
    return Brakings(motion, cart.pole_length.clone(), rightward, farthest)


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


def least_bound(brakings: Brakings, pole: GuardedPole, quantile: float) -> NDArray[np.float64]:
    """Return margin, delay, swing and 1 / (2 deceleration), which a share `quantile` of `brakings` obeys.

    The quantile regression is solved as its dual linear program, which has one variable for each braking.
    Raises ConfigError if the solver fails.
    """
    from scipy.optimize import linprog  # slow to import

    centre = centre_of_mass(brakings.motion, pole, brakings.length)
    x_dot = brakings.motion.x_dot
    rows = (torch.ones_like(x_dot), x_dot, centre.reach + centre.offset, centre.braked)
    terms, way = torch.stack(rows).double().numpy(), brakings.way.double().numpy()
    way = np.minimum(way, 1e3)  # only which side of the bound they are on matters
    shares = max(1 - quantile, 1 / len(way)) * terms.sum(1)  # all of them would leave the numbers open
    result = linprog(-way, A_ub=terms, b_ub=shares, bounds=(0, 1), method="highs-ipm")
    if not result.success:
        raise ConfigError(f"guard: its numbers could not be fitted ({result.message}); check cart.*")
    return -np.asarray(result.ineqlin.marginals)
