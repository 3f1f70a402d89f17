"""Identification of a cart from recordings: friction model, parameters with uncertainty, warnings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.identification.fit import Fit, fit_cart
from cartpole_rl.identification.replay import Replayed, replay
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.unknowns import WEIGHED, limits
from cartpole_rl.identification.windows import cut_windows
from cartpole_rl.physics.encoders import CART_METRES_PER_COUNT, POLE_RADIANS_PER_COUNT
from cartpole_rl.physics.models import CartFriction, Models
from cartpole_rl.tasks.endings import Ending
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.upright import wrap

Array = NDArray[np.floating]
CART_FRICTIONS = (CartFriction.LINEAR, CartFriction.SIGMOID, CartFriction.STEP, CartFriction.STRIBECK)
HORIZON = 1.0  # s of held-out motion, predicted
AWAY = 0.6  # rad from upright; nearer to it, an error grows e times in 0.15 s for any cart
SCREENING_STEPS = 4  # integration steps a period when a friction model is screened
CONTENDS = 1.5  # a screened model stays a candidate up to this multiple of the best one's error
FALLOFF = 4  # a model with twice the error of the best one has a weight of 2^-FALLOFF
FAR = 3.0  # prior standard deviations
UNINFORMED = 0.7  # posterior over prior standard deviation, from which the data say little
NO_WARNING = ("stribeck_velocity",)  # below 1 mm/s it makes no difference
ROUNDING = np.array([0.6, 0.6])  # counts: a generous bound of the effect of quantization
CORRELATED = 0.5  # correlation of neighbouring residuals from which they are not white


class PredictionError(NamedTuple):
    """RMS error of a prediction over HORIZON s, in the median stretch away from upright."""

    x: float  # m
    theta: float  # rad

    @property
    def size(self) -> float:
        """Both errors in one number."""
        return float(np.hypot(self.x / ALIKE.x, self.theta / ALIKE.theta))


ALIKE = PredictionError(5e-3, np.radians(2.0))  # errors of cart and pole with equal weight


class Candidate(NamedTuple):
    """A fit under one model of the cart's friction, and its predictions of held-out motion."""

    fit: Fit
    dynamics: Dynamics
    held_out: list[Replayed]
    error: PredictionError

    @property
    def cart_friction(self) -> CartFriction:
        """The model of the cart's friction."""
        return self.dynamics.models.cart_friction


@dataclass(frozen=True)
class Identification:
    """The result of an identification."""

    fit: Fit  # under the best friction model; its covariance includes how far the other fits lie from it
    dynamics: Dynamics  # of the identified cart
    candidates: list[Candidate]
    held_out: list[Replayed]
    error: PredictionError  # of `held_out`
    warnings: list[str]  # sentences: results that may be wrong

    @property
    def models(self) -> Models:
        """The physics models of the identified cart."""
        return self.dynamics.models


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

    The model of the cart's friction is chosen here; `models` gives the others. At most `most` windows are
    fitted to. Raises RecordingError where the recordings are not sufficient.
    """

    def attempt(cart_friction: CartFriction, count: int, steps: int, sharpened: bool) -> Candidate:
        under, half_step = models._replace(cart_friction=cart_friction), period / steps / 2
        windows = cut_windows(episodes, period, most=count)
        fit = fit_cart(
            windows,
            nominal,
            under,
            period,
            steps,
            known=WEIGHED,
            sharpened=sharpened,
            extra_latency=half_step,  # (3.8) moves a cart half a step early
        )
        dynamics = Dynamics.of(fit.parameters, under, period, steps, half_step)
        replays = replay(held_out, dynamics, HORIZON)
        return Candidate(fit, dynamics, replays, prediction_error(replays))

    screened = [attempt(each, most // 3, SCREENING_STEPS, False) for each in CART_FRICTIONS]
    largest = CONTENDS * min(each.error.size for each in screened)
    contenders = {
        each.cart_friction: attempt(each.cart_friction, most, substeps, True)
        for each in screened
        if each.error.size < largest
    }
    candidates = [contenders.get(each.cart_friction, each) for each in screened]
    best = min(contenders.values(), key=lambda each: each.error.size)
    fit = widened(best, [*contenders.values()])
    found = [*early_endings([*episodes, *held_out]), *warnings(fit)]
    return Identification(fit, best.dynamics, candidates, best.held_out, best.error, found)


def prediction_error(replays: Sequence[Replayed]) -> PredictionError:
    """Return the RMS errors over a stretch: the medians of the complete stretches away from upright."""
    x = np.concatenate([each.x_error for each in replays])
    theta = np.concatenate([each.theta_error for each in replays])
    angle = np.concatenate([each.theta - each.theta_error for each in replays])  # as measured
    whole = np.isfinite(x).all(1)
    away = whole & (np.abs(wrap(np.where(np.isfinite(angle), angle, np.pi))) > AWAY).all(1)
    kept = away if away.any() else whole
    x_error, theta_error = (float(np.median(np.sqrt((each[kept] ** 2).mean(1)))) for each in (x, theta))
    return PredictionError(x_error, theta_error)


def early_endings(episodes: Sequence[Episode]) -> list[str]:
    """Return a warning if the cart or its link ended recordings early."""
    cut = [each.ended_by for each in episodes if each.ended_by in (Ending.LINK, Ending.FAULT)]
    return [f"{len(cut)} of the recordings ended early, by {' and '.join(sorted({*cut}))}"] if cut else []


def widened(best: Candidate, candidates: Sequence[Candidate]) -> Fit:
    """Return the best fit, its covariance enlarged by the distance of the others' numbers from its own.

    No friction model is exact: one that predicts nearly as well is nearly as probable.
    """
    names = [unknown.name for unknown in best.fit.unknowns]
    covariance, total = np.zeros_like(best.fit.covariance), 1.0
    for other in candidates:
        if other is best:
            continue
        weight = (best.error.size / other.error.size) ** FALLOFF
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
