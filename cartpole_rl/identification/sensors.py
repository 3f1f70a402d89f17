"""Questions the sensors and the columns of recordings by their motion alone, before any cart is fitted.

Gravity and the acceleration of the cart act on the same pole. For a rigid pole, with the angle from upright,

    theta'' = (g sin(theta) - x'' cos(theta)) / l - d theta',

by equation (3.6) divided by the pivot inertia; l is the length of the equivalent simple pendulum. The true
angle is scale * (recorded - zero). A wrong scale or zero bends the sine, and a wrong scale of the position
changes the ratio of the two terms, so all three follow from motion.

Derivatives are those of cubics through seven or more samples (Savitzky and Golay, Anal. Chem. 36, 1964).
Intervals are 95 % by a bootstrap over recordings, or over pieces of one recording.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from cartpole_rl.physics.parameters import GRAVITY

Array = NDArray[np.float64]

WINDOW = 0.14  # s through which a cubic is laid
LEAST_ROWS = 7
LEAST_SAMPLES = 200  # of motion, for an estimate
SAMPLES = 20  # of the bootstrap
PIECE = 100  # rows of a recording that are drawn together
SWINGING = 1.0  # rad of the pole that tell its scale
DELAYS = np.arange(-2.0, 4.01, 0.25)  # periods
SPEED = 0.05  # m/s from which friction opposes the motion of the cart
SCALES = (1.0, np.pi / 180, 180 / np.pi)  # of the angle, from which a fit starts
WIDEST = 0.2, 0.1, 0.5  # interval of an estimate: scale of the angle, its zero in rad, scale of the position
OUTLIER = 3.0  # residuals, in median sizes, from which one counts less


class Motion(NamedTuple):
    """One recording at a constant period."""

    x: Array  # [T + 1] m
    theta: Array  # [T + 1] rad from upright, not wrapped
    motor: Array  # [T] chosen on the state of the same row


class Estimate(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def holds(self, value: float, margin: float = 0.0) -> bool:
        """Return True if `value` is in the interval, widened by `margin` on both sides."""
        return self.low - margin <= value <= self.high + margin


class Sensors(NamedTuple):
    """Estimates from motion; None where the recordings do not tell."""

    angle_scale: Estimate | None  # true over recorded angle
    angle_zero: Estimate | None  # rad, recorded angle of the upright pole
    position_scale: Estimate | None  # true over recorded position
    delay: Estimate | None  # s from a row's state until its motor value moves the cart
    push: float  # correlation of motor values and the cart's acceleration: negative means a wrong sign
    lag: float  # of the cart's acceleration and the pole's: negative means a wrong sign


class Samples:
    """Smoothed motion [K] of all recordings, away from their ends, and the piece of each row."""

    def __init__(self, motions: Sequence[Motion], period: float, rows: int) -> None:
        edge, piece = rows // 2, 0
        kept, pieces = [], []
        for motion in motions:
            length = len(motion.x)
            inside = np.arange(length)
            kept.append((inside >= edge) & (inside < length - edge))
            pieces.append(piece + inside // PIECE)
            piece = int(pieces[-1][-1]) + 1
        self._kept, self._period, self._rows = np.concatenate(kept), period, rows
        self.piece = np.unique(np.concatenate(pieces)[self._kept], return_inverse=True)[1]
        self._theta = np.concatenate([motion.theta for motion in motions])
        self.theta_dot, self.theta_ddot = self.smooth(self._theta, 1), self.smooth(self._theta, 2)
        x = np.concatenate([motion.x for motion in motions])
        self.x, self.x_dot, self.x_ddot = self.smooth(x), self.smooth(x, 1), self.smooth(x, 2)
        self._motions = motions

    def smooth(self, values: Array, derivative: int = 0) -> Array:
        """Return a derivative [K] of values in all rows."""
        filtered: Array = savgol_filter(values, self._rows, 3, deriv=derivative, delta=self._period)
        return filtered[self._kept]

    def pole_terms(self, scale: float = 1.0, zero: float = 0.0) -> Array:
        """Return the terms [K, 3] of the pole's acceleration: gravity, the cart, friction."""
        theta = scale * (self._theta - zero)
        return np.stack(
            (self.smooth(np.sin(theta)), -self.x_ddot * self.smooth(np.cos(theta)), -scale * self.theta_dot),
            1,
        )

    def push(self, periods: float) -> Array:
        """Return the smoothed motor value [K], in force `periods` after its state."""
        return self.smooth(np.concatenate([delayed(motion.motor, periods) for motion in self._motions]))


def question_sensors(
    motions: Sequence[Motion], period: float, seed: int = 0, on_step: Callable[[], object] = lambda: None
) -> Sensors:
    """Return what the motion says of the sensors of recordings with the control period `period`, s.

    `on_step` is called for each sample of the bootstrap.
    """
    rows = max(LEAST_ROWS, 2 * round(WINDOW / period / 2) + 1)
    kept = [motion for motion in motions if len(motion.motor) > rows + 2]
    if not kept:
        return Sensors(None, None, None, None, 0.0, 0.0)
    samples = Samples(kept, period, rows)
    pushes = [samples.push(each) for each in DELAYS]
    dice = np.random.default_rng(seed)
    swings = max(float(np.ptp(motion.theta)) for motion in kept) > SWINGING
    moves = len(samples.piece) >= LEAST_SAMPLES and samples.x_ddot.std() > 0
    scale = zero = position = delay = None
    if moves and swings:
        found = angle_estimates(samples, dice, on_step)
        known = (each.high - each.low < widest for each, widest in zip(found, WIDEST, strict=True))
        scale, zero, position = (each if sure else None for each, sure in zip(found, known, strict=True))
    if moves and pushes[0].std() > 0:
        delay = delay_estimate(samples, pushes, period, dice, on_step)
    correlations = [_correlation(push, samples.x_ddot) for push in pushes]
    return Sensors(scale, zero, position, delay, max(correlations, key=abs), _lag(samples))


def delayed(motor: Array, periods: float) -> Array:
    """Return the mean motor value [T + 1] around each row, each in force `periods` after its state.

    Around row t, half of the time belongs to the period before it and half to the one after.
    """
    steps = np.arange(len(motor) + 1, dtype=float)
    edges = np.concatenate((np.zeros(1), np.cumsum(motor)))  # integral of the value in force
    return np.interp(steps + 0.5 - periods, steps, edges) - np.interp(steps - 0.5 - periods, steps, edges)


def angle_estimates(
    samples: Samples, dice: np.random.Generator, on_step: Callable[[], object]
) -> tuple[Estimate, Estimate, Estimate]:
    """Return scale and zero of the angle, and the scale of the position."""

    def residuals(guess: Array, weights: Array | None = None) -> tuple[Array, Array]:
        terms, values = samples.pole_terms(*guess), guess[0] * samples.theta_ddot
        solution, errors = _regression(terms, values, weights)
        return errors / guess[0], solution

    def unexplained(guess: Array) -> float:
        return float(residuals(guess)[0].std() / samples.theta_ddot.std())

    def fitted(start: Array, weights: Array | None = None) -> tuple[float, float, float]:
        on_step()
        found = least_squares(
            lambda guess: residuals(guess, weights)[0], start, diff_step=1e-4, loss="soft_l1", f_scale=size
        )
        gravity, push, _ = residuals(found.x, weights)[1]
        return float(found.x[0]), float(found.x[1]), float(push * GRAVITY / gravity)

    start = min((np.array([scale, 0.0]) for scale in SCALES), key=unexplained)
    size = OUTLIER * float(np.median(np.abs(residuals(start)[0]))) + 1e-9
    best = fitted(start)
    drawn = [fitted(np.array(best[:2]), _weights(samples.piece, dice)) for _ in range(SAMPLES)]
    scale, zero, position = (
        _estimate(value, [each[column] for each in drawn]) for column, value in enumerate(best)
    )
    return scale, zero, position


def delay_estimate(
    samples: Samples,
    pushes: Sequence[Array],
    period: float,
    dice: np.random.Generator,
    on_step: Callable[[], object],
) -> Estimate:
    """Return the time from a state to the effect of its motor value on the cart, s."""
    direction = np.tanh(samples.x_dot / SPEED)

    def best(weights: Array | None) -> float:
        on_step()
        terms = (np.stack((push, samples.x_dot, direction, samples.x), 1) for push in pushes)
        sizes = [np.mean(_regression(each, samples.x_ddot, weights)[1] ** 2) for each in terms]
        return period * _lowest(DELAYS, np.array(sizes))

    return _estimate(best(None), [best(_weights(samples.piece, dice)) for _ in range(SAMPLES)])


def _regression(terms: Array, values: Array, weights: Array | None) -> tuple[Array, Array]:
    """Return the least-squares solution, and the weighted errors."""
    root = np.ones(len(values)) if weights is None else np.sqrt(weights)
    solution = np.asarray(np.linalg.lstsq(terms * root[:, None], values * root, rcond=None)[0], np.float64)
    return solution, (values - terms @ solution) * root


def _weights(piece: NDArray[np.int64], dice: np.random.Generator) -> Array:
    """Return how often each row is drawn if pieces are drawn with replacement."""
    number = int(piece[-1]) + 1
    return np.bincount(dice.integers(number, size=number), minlength=number)[piece].astype(float)


def _estimate(value: float, drawn: Sequence[float]) -> Estimate:
    spread = 1.96 * float(np.std(drawn))
    return Estimate(value, value - spread, value + spread)


def _lowest(places: Array, sizes: Array) -> float:
    """Return where a parabola through the lowest of `sizes` and its neighbours is lowest."""
    index = int(np.argmin(sizes))
    if index in (0, len(sizes) - 1):
        return float(places[index])
    before, now, after = sizes[index - 1 : index + 2]
    bend = before - 2 * now + after
    shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(places[index] + shift * (places[1] - places[0]))


def _lag(samples: Samples) -> float:
    """Return how much a cart that accelerates leaves its pole behind: 1 always, -1 never."""
    terms = samples.pole_terms()
    if len(terms) < LEAST_SAMPLES:
        return 0.0
    others = terms[:, ::2]
    free = samples.theta_ddot - others @ np.linalg.lstsq(others, samples.theta_ddot, rcond=None)[0]
    return _correlation(terms[:, 1], free)


def _correlation(first: Array, second: Array) -> float:
    spread = float(first.std() * second.std())
    return float(((first - first.mean()) * (second - second.mean())).mean() / spread) if spread > 0 else 0.0
