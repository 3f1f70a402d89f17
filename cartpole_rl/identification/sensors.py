"""Questions the sensors and the columns of recordings by their motion alone, before any cart is fitted.

Gravity and the acceleration of the cart act on the same pole. For a rigid pole, with the angle from upright,

    theta'' = (g sin(theta) - x'' cos(theta)) / l - d theta',

by equation (3.6) divided by the pivot inertia; l is the length of the equivalent simple pendulum. The true
angle is scale * (recorded - zero). A wrong scale or zero bends the sine, and a wrong scale of the position
changes the ratio of the two terms, so all three follow from motion.

Accelerations are those of cubics through seven or more samples (Savitzky and Golay, Anal. Chem. 36, 1964),
which is a weighted mean of second differences. Every other term is averaged by the same weights: two filters
that damp differently would bend the sine, as a wrong scale does.
Intervals are 95 % by a bootstrap over recordings, or over pieces of one recording.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.identification.fit import correlation
from cartpole_rl.physics.parameters import GRAVITY

Array = NDArray[np.float64]

WINDOW = 0.144  # s through which a cubic is laid: 9 rows at 20 ms
LEAST_ROWS = 7
LEAST_SAMPLES, LEAST_OF_A_SIGN = 200, 50  # of motion, for an estimate and for a sign
SAMPLES = 20  # of the bootstrap
PIECE = 100  # rows of a recording that are drawn together
SWINGING = 1.0  # rad of the pole that tell its scale
UNEXPLAINED = 0.25  # share of the acceleration of a pole that moves little; beyond it, noise may turn gravity
NUMEROV = np.array((1, 10, 1)) / 12  # the mean of an acceleration over which a second difference extends
EARLIEST, LATEST = 2, 4  # periods before and after its row in which a motor value may come into force
FURTHEST = 12  # periods by which it may be shifted
AT_ONCE = (-1.0, -0.5, 0.0, 0.5, 1.0)  # periods, delays at which a motor value shows its sign
LONGEST_DELAY = 0.06  # s; with a short period, more than LATEST
FINEST = 1e-3  # s between two delays that are tried, or a quarter of a period
SPEED = 0.05  # m/s from which friction opposes the motion of the cart
# of the angle, from which a fit starts: as it was told, half, double, and in other units
SCALES = (1.0, 0.5, 2.0, np.pi / 180, 180 / np.pi, 2 * np.pi, 0.5 / np.pi)
# widest intervals of the angle's scale, of its zero in rad, and of the position's scale; a scale over 1
# may have one that is as much wider
WIDEST = 0.2, 0.1, 0.5
FAR_BETTER = 0.5  # share of the unexplained at which another scale is taken for the right one
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
    falls_upwards: bool | None  # gravity pulls the pole to the recorded upright: the angle is half a turn off
    push: float  # `Samples.response`: negative means a wrong sign
    lag: float  # `Samples.lag`, with the angle from upright: negative means a wrong sign


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
        self._kept, self._period = np.concatenate(kept), period
        cubic = np.linalg.pinv(np.vander(np.arange(-edge, edge + 1), 4))  # through `rows` values
        # its second derivative, from their second differences, [rows - 2], sum 1
        self._weights = np.cumsum(np.cumsum(2 * cubic[1]))[:-2]
        self.piece = np.unique(np.concatenate(pieces)[self._kept], return_inverse=True)[1]
        self._theta = np.concatenate([motion.theta for motion in motions])
        x = np.concatenate([motion.x for motion in motions])
        self._theta_dot, x_dot = np.gradient(self._theta, period), np.gradient(x, period)
        self._x_ddot = self._second_difference(x)
        self.theta_ddot, self.x_ddot = (
            self.mean(self._second_difference(self._theta)),
            self.mean(self._x_ddot),
        )
        # of the pole's place beside its pivot, in lengths
        self.lean_ddot = self.mean(self._second_difference(np.sin(self._theta)))
        self.x, self.x_dot = self.mean(x), self.mean(x_dot)
        self._motions = motions

    @property
    def moves(self) -> bool:
        """True if there is motion enough for an estimate."""
        return len(self.piece) >= LEAST_SAMPLES and bool(self.x_ddot.std() > 0)

    @property
    def swings(self) -> bool:
        """True if the pole swings enough to tell its scale, whatever the unit of the angle."""
        widest = max(float(np.ptp(motion.theta)) for motion in self._motions)
        return self.unit * widest > SWINGING

    @property
    def unit(self) -> float:
        """The one of SCALES at which the equation explains the pole best."""
        return self._explained[1]

    @property
    def falls_upwards(self) -> bool | None:
        """True if gravity pulls the pole towards its recorded upright, whatever the unit of the angle.

        None if the motion does not tell: noise lowers the coefficient of gravity, and turns its sign if the
        pole moves little.
        """
        if not self.moves:
            return None
        unexplained, _, gravity = self._explained
        known = self.swings or unexplained < UNEXPLAINED * float(self.theta_ddot.std())
        return gravity < 0 if known else None

    @cached_property
    def _explained(self) -> tuple[float, float, float]:
        """Return the unexplained part of the equation at the best scale, the scale, and its gravity.

        The scale is the given one, unless another one explains far more.
        """
        told, *others = map(self._fit, SCALES)
        best = min(others)
        return best if best[0] < FAR_BETTER * told[0] else told

    def _fit(self, scale: float) -> tuple[float, float, float]:
        solution, errors = _regression(self.pole_terms(scale), scale * self.theta_ddot, None)
        return float(errors.std()) / scale, scale, float(solution[0])

    def gravity(self, scale: float) -> float:
        """Return the coefficient of gravity, 1/s^2, at a scale of the angle; negative means upwards."""
        return self._fit(scale)[2]

    def _second_difference(self, values: Array) -> Array:
        return np.convolve(values, (1, -2, 1), "same") / self._period**2

    def mean(self, values: Array) -> Array:
        """Return the weighted mean [K] of values in all rows."""
        return np.convolve(values, self._weights, "same")[self._kept]

    def pole_terms(self, scale: float = 1.0, zero: float = 0.0) -> Array:
        """Return the terms [K, 3] of the pole's acceleration: gravity, the cart, friction."""
        theta = scale * (self._theta - zero)
        gravity, friction = (np.convolve(each, NUMEROV, "same") for each in (np.sin(theta), self._theta_dot))
        terms = gravity, -self._x_ddot * np.cos(theta), -scale * friction
        return np.stack([self.mean(each) for each in terms], 1)

    @property
    def other_terms(self) -> Array:
        """The terms [K, 4] of the cart's acceleration beside the motor's: friction, the track, the pole."""
        return np.stack((self.x_dot, np.tanh(self.x_dot / SPEED), self.x, self.lean_ddot), 1)

    @property
    def response(self) -> float:
        """Correlation of motor value and immediate acceleration of the cart, all else removed, -1 to 1.

        Only short delays count. The speed is among all else, so an older value is left with the other sign.
        """
        if len(self.piece) < LEAST_OF_A_SIGN:
            return 0.0
        others, given = self.other_terms, (self.x_ddot, *map(self.push, AT_ONCE))
        free, *pushes = (_regression(others, each, None)[1] for each in given)
        return max((correlation(push, free) for push in pushes), key=abs)

    @property
    def lag(self) -> float:
        """Correlation of the cart's acceleration with the pole's lag behind it, -1 to 1."""
        if len(self.piece) < LEAST_OF_A_SIGN:
            return 0.0
        terms = self.pole_terms(self.unit)
        return correlation(terms[:, 1], _regression(terms[:, ::2], self.theta_ddot, None)[1])

    def push(self, periods: float) -> Array:
        """Return the mean motor value [K], in force `periods` after its state."""
        return self.mean(np.concatenate([delayed(motion.motor, periods) for motion in self._motions]))


def question_sensors(
    motions: Sequence[Motion], period: float, on_step: Callable[[], object] = lambda: None
) -> Sensors:
    """Return what the motion says of the sensors of recordings with the control period `period`, s.

    `on_step` is called for each sample of the bootstrap.
    """
    samples = samples_of(motions, period)
    if samples is None:
        return Sensors(None, None, None, None, None, 0.0, 0.0)
    dice = np.random.default_rng(0)
    upwards = samples.falls_upwards
    scale = zero = position = delay = None
    if samples.moves and samples.swings:
        found = angle_estimates(samples, dice, on_step)
        known = (
            each.high - each.low < widest * max(1.0, abs(size))
            for each, widest, size in zip(found, WIDEST, (found[0].value, 1, found[2].value), strict=True)
        )
        scale, zero, position = (each if sure else None for each, sure in zip(found, known, strict=True))
        scale, position = (each if each and each.low > 0 else None for each in (scale, position))
        upwards = upwards if scale is None else samples.gravity(scale.value) < 0
        zero = None if upwards else zero
    if samples.moves and samples.push(0).std() > 0:
        delay = delay_estimate(samples, period, dice, on_step)
    lag = -samples.lag if upwards else samples.lag
    return Sensors(scale, zero, position, delay, upwards, samples.response, lag)


def samples_of(motions: Sequence[Motion], period: float) -> Samples | None:
    """Return the samples of recordings with the control period `period`, s; None if they are too short."""
    rows = max(LEAST_ROWS, 2 * round(WINDOW / period / 2) + 1)
    kept = [motion for motion in motions if len(motion.motor) > rows + 2]
    return Samples(kept, period, rows) if kept else None


def delayed(motor: Array, periods: float) -> Array:
    """Return the mean motor value [T + 1] around each row, each in force `periods` after its state.

    The mean is the second difference of the value's double integral, as accelerations are those of positions.
    """
    once = np.concatenate((np.zeros(1), np.cumsum(motor)))  # integral of the value in force, at each row
    twice = np.concatenate((np.zeros(1), np.cumsum(once[:-1] + motor / 2)))

    def integral(rows: Array) -> Any:
        row = np.clip(np.floor(rows).astype(int), 0, len(motor) - 1)
        part = rows - row
        return twice[row] + once[row] * part + motor[row] * part**2 / 2

    at = np.arange(len(motor) + 1, dtype=np.float64) - periods
    return np.asarray(integral(at + 1) - 2 * integral(at) + integral(at - 1), np.float64)


def angle_estimates(
    samples: Samples, dice: np.random.Generator, on_step: Callable[[], object]
) -> tuple[Estimate, Estimate, Estimate]:
    """Return scale and zero of the angle, and the scale of the position."""
    from scipy.optimize import least_squares  # slow to import

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
    samples: Samples, period: float, dice: np.random.Generator, on_step: Callable[[], object]
) -> Estimate | None:
    """Return the time from a state to the effect of its motor value on the cart, s; None if it is not clear.

    By equation (3.5), the centre of mass of cart and pole accelerates under motor and friction alone.
    """
    others = samples.other_terms

    def unexplained(pushes: Sequence[Array], weights: Array | None = None) -> Array:
        terms = (np.column_stack((push, others)) for push in pushes)
        return np.array([np.mean(_regression(each, samples.x_ddot, weights)[1] ** 2) for each in terms])

    first, last = -float(EARLIEST), max(LATEST, LONGEST_DELAY / period)
    shifts = np.arange(-FURTHEST, FURTHEST + 1)
    shift = int(shifts[unexplained([samples.push(float(each)) for each in shifts]).argmin()])
    if shifted := not first <= shift <= last:
        first, last = shift - 1, shift + 1.0
    delays = np.arange(first, last + 0.01, max(0.25, FINEST / period))
    pushes, delays = [samples.push(each) for each in delays], period * delays

    def best(weights: Array | None) -> float:
        on_step()
        return _lowest(delays, unexplained(pushes, weights))

    found = _estimate(best(None), [best(_weights(samples.piece, dice)) for _ in range(SAMPLES)])
    sure = not shifted or found.high - found.low < period
    return found if sure and delays[0] < found.value < delays[-1] else None


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
