"""From recordings to a cart: which law of friction, which numbers, how surely, and how far it predicts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.identification.fit import Fit, fit_cart
from cartpole_rl.identification.replay import Replayed, replay
from cartpole_rl.identification.unknowns import WEIGHED, limits
from cartpole_rl.identification.windows import cut_windows
from cartpole_rl.physics.models import CartFriction, Models
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.tasks.upright import wrap

Array = NDArray[np.floating]
LAWS = (CartFriction.LINEAR, CartFriction.SIGMOID, CartFriction.STEP, CartFriction.STRIBECK)
WINDOW = 0.5  # s
HORIZON = 1.0  # s of held-out motion, predicted
AWAY = 0.6  # rad from upright: nearer, an error grows e times in 0.15 s, whatever the cart
UNIT = np.array([5e-3, np.radians(2.0)])  # m, rad: errors of cart and pole that weigh alike
COARSE, CONTENDS = (
    4,
    1.5,
)  # integration steps of a first look at a law; its error, to the best one's, to go on
WORSE = 4  # a law whose error is twice the best one's counts 2^-WORSE as much
FAR = 3.0  # standard deviations from what was thought before
UNTOLD = 0.7  # of the deviation before: what is left of it where the data say little
SMALL_PRINT = ("stribeck_velocity",)  # below 1 mm/s it makes no difference
NOISE = np.array([0.6, 0.6])  # counts that rounding leaves, generously
ALIKE = 0.5  # correlation of neighbouring residuals from which they are no noise


class Tried(NamedTuple):
    """One law of the cart's friction, and what it is worth on motion that it was not fitted to."""

    law: CartFriction
    fit: Fit
    x_error: float  # m, RMS over HORIZON of the median stretch
    theta_error: float  # rad, the same

    @property
    def error(self) -> float:
        """Both errors in one number."""
        return float(np.hypot(self.x_error / UNIT[0], self.theta_error / UNIT[1]))


@dataclass(frozen=True)
class Identification:
    """What was found."""

    fit: Fit  # under the best law; what the others found instead widens its covariance
    models: Models
    tried: list[Tried]
    held_out: list[Replayed]
    doubts: list[str]  # sentences: what a user should not believe


def identify(
    episodes: Sequence[Episode],
    held_out: Sequence[Episode],
    nominal: Mapping[str, float],
    models: Models,
    period: float,
    substeps: int = 12,
    most: int = 300,
) -> Identification:
    """The cart that `episodes` were recorded on, judged by `held_out`, with the pole of `nominal`.

    `models` says all but the law of the cart's friction. Raises RecordingError where recordings will not do.
    """

    def attempt(law: CartFriction, count: int, steps: int, sharpened: bool) -> Tried:
        windows = cut_windows(episodes, period, round(WINDOW / period), count)
        under = models._replace(cart_friction=law)
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
        return Tried(law, fit, *prediction_errors(predicted(held_out, fit, under, period, steps)))

    screened = [attempt(law, most // 3, COARSE, False) for law in LAWS]
    good = CONTENDS * min(each.error for each in screened)
    tried = [attempt(each.law, most, substeps, True) if each.error < good else each for each in screened]
    contenders = [now for now, then in zip(tried, screened, strict=True) if now is not then]
    best = min(contenders, key=lambda each: each.error)
    chosen, fit = models._replace(cart_friction=best.law), widened(best, contenders)
    cut = [each.ended_by for each in (*episodes, *held_out) if each.ended_by in ("link", "fault")]
    doubted = [f"{len(cut)} of the recordings ended early, by {' and '.join(sorted({*cut}))}"] if cut else []
    return Identification(
        fit, chosen, tried, predicted(held_out, fit, chosen, period, substeps), doubted + doubts(fit)
    )


def lead(period: float, substeps: int) -> float:
    """Half a step, s: by so much (3.8) moves a cart early."""
    return period / substeps / 2


def predicted(
    episodes: Sequence[Episode], fit: Fit, models: Models, period: float, substeps: int
) -> list[Replayed]:
    """Recordings beside the cart that was found, put back onto them every HORIZON s."""
    return replay(episodes, fit.parameters, models, period, substeps, HORIZON, lead(period, substeps))


def prediction_errors(replays: Sequence[Replayed]) -> tuple[float, float]:
    """RMS of x (m) and theta (rad) over a stretch: the medians of those that keep away from upright."""
    x = np.concatenate([each.x_error for each in replays])
    theta = np.concatenate([each.theta_error for each in replays])
    angle = np.concatenate([each.theta - each.theta_error for each in replays])  # as measured
    whole = np.isfinite(x).all(1)
    away = whole & (np.abs(wrap(np.where(np.isfinite(angle), angle, np.pi))) > AWAY).all(1)
    kept = away if away.any() else whole
    x_error, theta_error = (float(np.median(np.sqrt((each[kept] ** 2).mean(1)))) for each in (x, theta))
    return x_error, theta_error


def widened(best: Tried, tried: Sequence[Tried]) -> Fit:
    """The best fit, its covariance grown by how far the others' numbers lie from its own.

    No law is the cart's own. One that predicts nearly as well has nearly as good a claim.
    """
    names = [unknown.name for unknown in best.fit.unknowns]
    covariance, total = np.zeros_like(best.fit.covariance), 1.0
    for other in tried:
        if other is best:
            continue
        weight = (best.error / other.error) ** WORSE
        theirs = {
            unknown.name: value for unknown, value in zip(other.fit.unknowns, other.fit.point, strict=True)
        }
        away = np.array(
            [theirs.get(name, own) - own for name, own in zip(names, best.fit.point, strict=True)]
        )
        covariance += weight * np.outer(away, away)
        total += weight
    values, vectors = np.linalg.eigh(best.fit.covariance + covariance / total)
    known = np.minimum(values, 1.0)  # nobody knows less after measuring than before
    return replace(best.fit, covariance=vectors * known @ vectors.T)


def doubts(fit: Fit) -> list[str]:
    """What a fit that looks fine may hide."""
    said = []
    low, high = limits(fit.unknowns, fit.nominal)
    deviation = np.sqrt(np.diag(fit.covariance))
    found = fit.parameters
    for unknown, point, least, most, left in zip(fit.unknowns, fit.point, low, high, deviation, strict=True):
        if min(point - least, most - point) < 1e-6:
            said.append(
                f"{unknown.name} sits at {found[unknown.name]:g}, the end of what it can be: "
                "another law, or another number, may be wrong"
            )
        elif abs(point) > FAR and unknown.name not in SMALL_PRINT:
            said.append(
                f"{unknown.name} = {found[unknown.name]:.3g} is far from what carts of this kind have: "
                "check that the right pole and cart were given"
            )
        if left > UNTOLD and unknown.name not in SMALL_PRINT:
            said.append(f"the recordings hardly tell {unknown.name}: what was thought of it before is kept")
    for name, rms, noise, alike, unit in zip(
        ("cart", "pole"), fit.rms, NOISE, fit.correlation, ("0.0227 mm", "0.088 deg"), strict=True
    ):
        if rms > noise and alike > ALIKE:
            said.append(
                f"what the fit leaves of the {name}'s position, {rms:.1f} counts of {unit}, is no noise "
                f"(neighbours correlate by {alike:.2f}): the laws lack something"
            )
    return said
