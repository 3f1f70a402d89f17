"""From recordings to a cart: its friction model, its numbers with their uncertainty, and warnings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.identification.fit import Fit, fit_cart
from cartpole_rl.identification.replay import Replayed, replay
from cartpole_rl.identification.unknowns import WEIGHED, limits
from cartpole_rl.identification.windows import cut_windows
from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.physics.models import CartFriction, Models
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.upright import wrap

Array = NDArray[np.floating]
CART_FRICTIONS = (CartFriction.LINEAR, CartFriction.SIGMOID, CartFriction.STEP, CartFriction.STRIBECK)
WINDOW = 0.5  # s
HORIZON = 1.0  # s of held-out motion, predicted
AWAY = 0.6  # rad from upright; nearer to it, an error grows e times in 0.15 s, whatever the cart
UNIT = np.array([5e-3, np.radians(2.0)])  # m, rad: errors of cart and pole that weigh alike
SCREENING_STEPS = 4  # integration steps a period when a friction model is screened
CONTENDS = 1.5  # a screened model stays a candidate up to this multiple of the best one's error
FALLOFF = 4  # a model with twice the error of the best one has a weight of 2^-FALLOFF
FAR = 3.0  # prior standard deviations
UNINFORMED = 0.7  # posterior over prior standard deviation, from which the data say little
NO_WARNING = ("stribeck_velocity",)  # below 1 mm/s it makes no difference
ROUNDING = np.array([0.6, 0.6])  # counts: a generous bound of the effect of quantization
CORRELATED = 0.5  # correlation of neighbouring residuals from which they are not white


class Candidate(NamedTuple):
    """A fit under one model of the cart's friction, and its errors on held-out motion."""

    cart_friction: CartFriction
    fit: Fit
    x_error: float  # m, RMS over HORIZON of the median stretch
    theta_error: float  # rad, the same

    @property
    def error(self) -> float:
        """Both errors in one number."""
        return float(np.hypot(self.x_error / UNIT[0], self.theta_error / UNIT[1]))


@dataclass(frozen=True)
class Identification:
    """The result of an identification."""

    fit: Fit  # under the best friction model; its covariance includes how far the other fits lie from it
    models: Models
    candidates: list[Candidate]
    held_out: list[Replayed]
    warnings: list[str]  # sentences: results that may be wrong


def identify(
    episodes: Sequence[Episode],
    held_out: Sequence[Episode],
    nominal: Mapping[str, float],
    models: Models,
    period: float,
    substeps: int = 12,
    most: int = 300,
) -> Identification:
    """Identify the cart that `episodes` were recorded on, judged by `held_out`, with the pole of `nominal`.

    The model of the cart's friction is chosen here; `models` gives the others. Raises RecordingError where
    the recordings are not sufficient.
    """

    def attempt(cart_friction: CartFriction, count: int, steps: int, sharpened: bool) -> Candidate:
        windows = cut_windows(episodes, period, round(WINDOW / period), count)
        under = models._replace(cart_friction=cart_friction)
        fit = fit_cart(
            windows,
            nominal,
            under,
            period,
            steps,
            known=WEIGHED,
            sharpened=sharpened,
            lead=lead(period, steps),
        )
        return Candidate(
            cart_friction, fit, *prediction_errors(predicted(held_out, fit, under, period, steps))
        )

    screened = [attempt(each, most // 3, SCREENING_STEPS, False) for each in CART_FRICTIONS]
    good = CONTENDS * min(each.error for each in screened)
    candidates = [
        attempt(each.cart_friction, most, substeps, True) if each.error < good else each for each in screened
    ]
    contenders = [now for now, then in zip(candidates, screened, strict=True) if now is not then]
    best = min(contenders, key=lambda each: each.error)
    chosen, fit = models._replace(cart_friction=best.cart_friction), widened(best, contenders)
    cut = [each.ended_by for each in (*episodes, *held_out) if each.ended_by in ("link", "fault")]
    early = [f"{len(cut)} of the recordings ended early, by {' and '.join(sorted({*cut}))}"] if cut else []
    return Identification(
        fit, chosen, candidates, predicted(held_out, fit, chosen, period, substeps), early + warnings(fit)
    )


def lead(period: float, substeps: int) -> float:
    """Return half a step, s: the time by which (3.8) moves a cart early."""
    return period / substeps / 2


def predicted(
    episodes: Sequence[Episode], fit: Fit, models: Models, period: float, substeps: int
) -> list[Replayed]:
    """Return recordings beside the identified cart, which is put back onto them every HORIZON s."""
    return replay(episodes, fit.parameters, models, period, substeps, HORIZON, lead(period, substeps))


def prediction_errors(replays: Sequence[Replayed]) -> tuple[float, float]:
    """Return the RMS of x (m) and theta (rad) over a stretch: the medians of those away from upright."""
    x = np.concatenate([each.x_error for each in replays])
    theta = np.concatenate([each.theta_error for each in replays])
    angle = np.concatenate([each.theta - each.theta_error for each in replays])  # as measured
    whole = np.isfinite(x).all(1)
    away = whole & (np.abs(wrap(np.where(np.isfinite(angle), angle, np.pi))) > AWAY).all(1)
    kept = away if away.any() else whole
    x_error, theta_error = (float(np.median(np.sqrt((each[kept] ** 2).mean(1)))) for each in (x, theta))
    return x_error, theta_error


def widened(best: Candidate, candidates: Sequence[Candidate]) -> Fit:
    """Return the best fit, its covariance enlarged by the distance of the others' numbers from its own.

    No friction model is exact: one that predicts nearly as well is nearly as probable.
    """
    names = [unknown.name for unknown in best.fit.unknowns]
    covariance, total = np.zeros_like(best.fit.covariance), 1.0
    for other in candidates:
        if other is best:
            continue
        weight = (best.error / other.error) ** FALLOFF
        theirs = {
            unknown.name: value for unknown, value in zip(other.fit.unknowns, other.fit.point, strict=True)
        }
        away = np.array(
            [theirs.get(name, own) - own for name, own in zip(names, best.fit.point, strict=True)]
        )
        covariance += weight * np.outer(away, away)
        total += weight
    values, vectors = np.linalg.eigh(best.fit.covariance + covariance / total)
    bounded = np.minimum(values, 1.0)  # the posterior is not wider than the prior
    return replace(best.fit, covariance=vectors * bounded @ vectors.T)


def warnings(fit: Fit) -> list[str]:
    """Return a sentence for each result of a fit that may be wrong."""
    found = []
    low, high = limits(fit.unknowns, fit.nominal)
    deviation = np.sqrt(np.diag(fit.covariance))
    values = fit.parameters
    for unknown, point, least, most, left in zip(fit.unknowns, fit.point, low, high, deviation, strict=True):
        if min(point - least, most - point) < 1e-6:
            found.append(
                f"{unknown.name} = {values[unknown.name]:g} is at the limit of its range: another friction "
                "model, or another number, may be wrong"
            )
        elif abs(point) > FAR and unknown.name not in NO_WARNING:
            found.append(
                f"{unknown.name} = {values[unknown.name]:.3g} is unusual for carts of this kind: check that "
                "the right pole and cart were given"
            )
        if left > UNINFORMED and unknown.name not in NO_WARNING:
            found.append(f"the recordings hardly show {unknown.name}: its prior value is kept")
    units = f"{1e3 * CART_METRES_PER_COUNT:.2g} mm", f"{np.degrees(POLE_RADIANS_PER_COUNT):.2g} deg"
    for name, rms, rounding, correlation, unit in zip(
        ("cart", "pole"), fit.rms, ROUNDING, fit.correlation, units, strict=True
    ):
        if rms > rounding and correlation > CORRELATED:
            found.append(
                f"the residuals of the {name}'s position, {rms:.1f} counts of {unit}, are not white "
                f"(neighbours correlate by {correlation:.2f}): the physics models lack something"
            )
    return found
