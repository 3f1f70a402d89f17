"""Identification of a cart from recordings: friction model, parameters with uncertainty, warnings."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError
from cartpole_rl.identification.checks import check_explained, hardly_explained
from cartpole_rl.identification.fit import Fit, fit_cart, within_prior
from cartpole_rl.identification.prediction import LEAD, Replayed, is_away, predict
from cartpole_rl.identification.rollout import Dynamics
from cartpole_rl.identification.unknowns import WEIGHED, limits
from cartpole_rl.identification.windows import Windows, cut_judging, cut_windows, lead_periods, naming
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.laws import Law
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import GRAVITY, CartParameters
from cartpole_rl.rig.hardware import Encoders
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.settings import CONFIDENCE
from cartpole_rl.tasks.episode import Ending, Episode

Array = NDArray[np.floating]
HORIZON = 1.0  # s of motion, predicted
FEW = 4  # stretches; the median of fewer is no error to rely on
MOVING = 0.02  # m in that time, from which a friction model shows
COARSE_STEPS = 4  # integration steps a period when friction models are compared
CONTENDS = 1.5  # a screened model stays a candidate up to this multiple of the best one's error
FALLOFF = 4  # a model with twice the error of the best one has a weight of 2^-FALLOFF
UNINFORMED = 0.7  # posterior over prior standard deviation, from which the data say little
ROUNDING = 0.6  # counts: a generous bound of the effect of quantization
CORRELATED = 0.5  # correlation of neighbouring residuals from which they are not white
TYPICAL = 5.0  # rad/s, the speed of a wide swing, for which the pole's damping is given
WORDS = {  # of quantities, name: words, unit
    "pole_frequency": ("frequency of the pole's small swing", "Hz"),
    "pole_damping": (f"damping of the pole at {TYPICAL:g} rad/s", "rad/s^2"),
    "force_gain": ("motor: force per motor value over mass", "mm/s^2"),
    "force_asymmetry": ("motor: more force to the right by", "%"),
    "deadband": ("motor: no force up to motor value", ""),
    "viscous": ("cart: viscous friction over mass", "1/s"),
    "coasting": ("cart: less of it with the motor off by", "%"),
    "coulomb": ("cart: Coulomb friction over mass", "m/s^2"),
    "coulomb_asymmetry": ("cart: more Coulomb friction to the right by", "%"),
    "stiction": ("cart: breakaway over Coulomb friction", ""),
    "latency": ("latency", "ms"),
    "lag": ("motor: time constant", "ms"),
    "tilt": ("track: the right end is lower by", "deg"),
    "angle_offset": ("pole: measured minus true angle", "deg"),
}


class PredictionError(NamedTuple):
    """RMS error of a prediction over HORIZON s, in the median stretch away from upright."""

    x: float  # m
    theta: float  # rad
    away: int = 0  # stretches away from upright; where there are none, it is the median of all
    stretches: int = 0

    @property
    def size(self) -> float:
        """Both errors in one number."""
        return float(np.hypot(self.x / ALIKE.x, self.theta / ALIKE.theta))


ALIKE = PredictionError(5e-3, np.radians(2.0))  # errors of cart and pole with equal weight


class Candidate(NamedTuple):
    """A fit under one model of the cart's friction, and its error where it was not fitted."""

    fit: Fit
    dynamics: Dynamics
    error: PredictionError

    @property
    def cart_friction(self) -> Law:
        """The model of the cart's friction."""
        return self.dynamics.models.cart_friction


@dataclass(frozen=True)
class Identification:
    """The result of an identification: the cart that was found, as held-out recordings judge it."""

    fit: Fit  # under the best friction law; its covariance includes how far the other fits lie from it
    dynamics: Dynamics
    candidates: list[Candidate]
    fitted: list[Replayed]
    held_out: list[Replayed]
    error: PredictionError  # of `held_out`
    warnings: list[str]  # sentences: results that may be wrong

    @property
    def models(self) -> Models:
        """The physics models of the identified cart."""
        return self.dynamics.models


def identify(
    fitted: Mapping[str, Episode],
    held_out: Mapping[str, Episode],
    nominal: Mapping[str, float],
    models: Models,
    period: float,
    substeps: int = 12,
    most: int = 300,
    laws: Sequence[Law] = (),
    on_step: Callable[[], object] = lambda: None,
) -> Identification:
    """Identify the cart that recordings, by the names of their files, are of, with the pole of `nominal`.

    The law of the cart's friction is chosen here, among the registered candidates and further `laws`: the one
    that best predicts seconds of the episodes `fitted` to that were left out of its fit. `models` gives the
    others, and the law that is tried first. Each search starts where the one before it ended. The chosen law
    is then fitted to at most `most` windows of all these episodes. `held_out` only gives the error that is
    reported. Raises RecordingError where the recordings are not sufficient, or no cart explains one of them.
    """
    episodes = [*fitted.values()]
    lead = lead_periods(LEAD, period)
    judging = cut_judging(episodes, period, HORIZON, lead, MOVING)
    with naming("the held-out recordings"):  # before the long fit: they have to give an error
        cut_judging([*held_out.values()], period, HORIZON, lead, 0.0)

    def attempt(
        cart_friction: Law,
        count: int,
        steps: int,
        near: Fit | None = None,
        apart_from: Windows | None = judging,
    ) -> Candidate:
        under, half_step = models._replace(cart_friction=cart_friction), period / steps / 2
        windows = cut_windows(episodes, period, most=count, apart_from=apart_from)
        fit = fit_cart(
            windows,
            nominal,
            under,
            period,
            steps,
            known=WEIGHED,
            extra_latency=half_step,  # (3.8) moves a cart half a step early
            near=near,
            sizes=None if near is None else first.fit.spread,
            on_step=on_step,
        )
        dynamics = Dynamics.of(fit.parameters, under, period, steps, half_step)
        simulated, error, _ = predict(judging, dynamics)
        x_error, theta_error = error.transpose(1, 2, 0)
        every = np.full(judging.number, True)  # also one that is not finite, which no cart may cause
        return Candidate(fit, dynamics, median_error(x_error, theta_error, simulated[:, 1].T, every))

    frictions = dict.fromkeys([*(each for each in CART_FRICTIONS.loaded() if each.candidate), *laws])
    first = attempt(models.cart_friction, most // 3, COARSE_STEPS)
    screened = [
        first if each == first.cart_friction else attempt(each, most // 3, COARSE_STEPS, first.fit)
        for each in frictions
    ]
    if not np.isfinite([each.error.size for each in screened]).all():
        raise RecordingError(
            "no cart near the numbers of cart= and pole= moves as in these recordings: check those numbers, "
            "and the units and signs of the recordings"
        )
    largest = CONTENDS * min(each.error.size for each in screened)
    contenders = {
        each.cart_friction: attempt(each.cart_friction, most, COARSE_STEPS, each.fit)
        for each in screened
        if each.error.size < largest
    }
    candidates = [contenders.get(each.cart_friction, each) for each in screened]
    best = min(contenders.values(), key=lambda each: each.error.size)
    whole = attempt(best.cart_friction, most, substeps, best.fit, apart_from=None)
    fit = widened(whole.fit, best, [*contenders.values()])
    return judged(fit, whole.dynamics, candidates, fitted, held_out)


def judged(
    fit: Fit,
    dynamics: Dynamics,
    candidates: list[Candidate],
    fitted: Mapping[str, Episode],
    held_out: Mapping[str, Episode],
) -> Identification:
    """Return the cart with the error of its predictions.

    Raises RecordingError for a motion of another cart.
    """
    explained = check_explained(fitted, dynamics, HORIZON)
    replays = check_explained(held_out, dynamics, HORIZON)
    motion = zip(*((each.x_error, each.theta_error, each.theta) for each in replays), strict=True)
    x_error, theta_error, theta = map(np.concatenate, motion)
    error = median_error(x_error, theta_error, theta, np.isfinite(x_error).all(1))
    doubts = [
        *early_endings([*fitted.values(), *held_out.values()]),
        *warnings(fit, next(iter(fitted.values())).encoders),
        *hardly_judged(error),
        *hardly_explained(fitted, explained, dynamics),
        *hardly_explained(held_out, replays, dynamics),
    ]
    return Identification(fit, dynamics, candidates, explained, replays, error, doubts)


def median_error(
    x_error: Array, theta_error: Array, angle: Array, whole: NDArray[np.bool_]
) -> PredictionError:
    """Return the medians of the RMS errors of stretches, [S, T + 1], that are `whole` and away from upright.

    If none is, those that are `whole` count. `angle` is simulated.
    """
    away = whole & is_away(angle - theta_error)
    kept = away if away.any() else whole
    x, theta = (float(np.median(np.sqrt((each[kept] ** 2).mean(1)))) for each in (x_error, theta_error))
    return PredictionError(x, theta, int(away.sum()), int(whole.sum()))


def early_endings(episodes: Sequence[Episode]) -> list[str]:
    """Return a warning if the cart or its link ended recordings early."""
    cut = [each.ended_by for each in episodes if each.ended_by in (Ending.LINK, Ending.FAULT)]
    return [f"{len(cut)} of the recordings ended early, by {' and '.join(sorted({*cut}))}"] if cut else []


def hardly_judged(error: PredictionError) -> list[str]:
    """Return a warning if the error is that of few stretches away from upright."""
    if error.away >= FEW:
        return []
    return [
        f"{error.away} of {error.stretches} held-out seconds are away from upright: the prediction error is "
        "uncertain; record more motion with the pole away from upright"
    ]


def widened(fit: Fit, best: Candidate, candidates: Sequence[Candidate]) -> Fit:
    """Return `fit`, its covariance enlarged by the distances of the other candidates from the `best` one.

    No friction model is exact: one that predicts nearly as well is nearly as probable. `fit` has the friction
    model of `best`.
    """
    covariance, total = np.zeros_like(fit.covariance), 1.0
    for other in candidates:
        if other is best:
            continue
        weight = (best.error.size / other.error.size) ** FALLOFF
        theirs, own = other.fit.by_name, best.fit.by_name
        away = np.array([theirs.get(name, own[name]) - own[name] for name in own])
        covariance += weight * np.outer(away, away)
        total += weight
    return replace(fit, covariance=within_prior(fit.covariance + covariance / total))


def warnings(fit: Fit, encoders: Encoders) -> list[str]:
    """Return a sentence for each result of a fit that may be wrong."""
    found = []
    low, high = limits(fit.unknowns, fit.nominal)
    deviation = np.sqrt(np.diag(fit.covariance))
    values = fit.parameters
    for unknown, point, least, most, left in zip(fit.unknowns, fit.point, low, high, deviation, strict=True):
        absent = unknown.name in PARAMETERS and values[unknown.name] == PARAMETERS[unknown.name].default
        if min(point - least, most - point) < 1e-6 and not absent:
            found.append(
                f"{unknown.name} = {values[unknown.name]:g} is at the limit of its range: another friction "
                "model, or another number, may be wrong"
            )
        elif abs(point) > unknown.prior.unusual:
            found.append(
                f"{unknown.name} = {values[unknown.name]:.3g} is unusual for carts of this kind: check that "
                "the right pole and cart were given"
            )
        if left > UNINFORMED and abs(point) < 1 and np.isfinite(unknown.prior.unusual):
            found.append(f"the recordings hardly show {unknown.name}: its value is uncertain")
    texts = f"{1e3 * fit.spread[0]:.2g} mm", f"{np.degrees(fit.spread[1]):.2g} deg"
    for name, spread, size, correlation, text in zip(
        ("cart", "pole"), fit.spread, encoders.resolution, fit.correlation, texts, strict=True
    ):
        if spread > ROUNDING * size and correlation > CORRELATED:
            found.append(
                f"the residuals of the {name}'s position, {text}, are not white "
                f"(neighbours correlate by {correlation:.2f}): the physics models lack something"
            )
    return found


class Quantity(NamedTuple):
    """One quantity, with its interval."""

    name: str
    words: str
    unit: str
    value: float
    low: float = math.nan  # of its 95 % interval
    high: float = math.nan
    prior: float = math.nan


def quantities(cart: Mapping[str, float]) -> list[Quantity]:
    """Return the quantities of one cart, from its parameters. The force is that about motor value 200."""
    mass = cart["cart_mass"] + cart.get("backdrivability", 1.0) * cart["pole_mass"]
    moment = cart["pole_mass"] * cart["pole_com"]
    inertia = cart["pole_inertia"] + moment * cart["pole_com"]
    damping = cart["pole_viscous"] * TYPICAL + cart["pole_drag"] * TYPICAL**2 + cart["pole_coulomb"]
    gain = cart["force_linear"] + 400 * cart["force_quadratic"]
    values = {
        "pole_frequency": math.sqrt(moment * GRAVITY / inertia) / (2 * math.pi),
        "pole_damping": damping / inertia,
        "force_gain": 1e3 * gain * (1 + cart["force_asymmetry"] / 2) / mass,
        "force_asymmetry": 100 * cart["force_asymmetry"],
        "deadband": no_force_up_to(cart),
        "viscous": cart["cart_viscous"] / mass,
        "coasting": 100 * cart["coasting"],
        "coulomb": cart["cart_coulomb"] / mass,
        "coulomb_asymmetry": 200 * cart["cart_coulomb_asymmetry"],
        "stiction": cart["cart_stiction_ratio"],
        "latency": 1e3 * cart["latency"],
        "lag": 1e3 * cart["motor_time_constant"],
        "tilt": math.degrees(cart["track_tilt"]),
        "angle_offset": math.degrees(cart["angle_offset"]),
    }
    return [Quantity(name, *WORDS[name], value) for name, value in values.items()]


def no_force_up_to(cart: Mapping[str, float]) -> float:
    """Return the motor value up to which there is no force: the dead-bands' mean, or the curve's zero."""
    a, b, c = (cart[f"force_{name}"] for name in ("quadratic", "linear", "offset"))
    zero = -c / b if abs(a) < 1e-12 else (-b + math.sqrt(max(0.0, b * b - 4 * a * c))) / (2 * a)
    return (max(zero, cart["deadband_left"]) + max(zero, cart["deadband_right"])) / 2


def intervals(fit: Fit, carts: Array) -> list[Quantity]:
    """Return the identified quantities: prior values, and 95 % intervals of `carts` [P, N] from the fit."""
    names = CartParameters.names()
    drawn = [quantities(dict(zip(names, cart.tolist(), strict=True))) for cart in carts.T]
    values = np.array([[quantity.value for quantity in cart] for cart in drawn])  # [N, Q]
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(values, [tail, 100 - tail], axis=0).tolist()
    prior = [quantity.value for quantity in quantities(fit.nominal)]
    return [
        each._replace(low=least, high=most, prior=before)
        for each, least, most, before in zip(quantities(fit.parameters), low, high, prior, strict=True)
        if most > least  # a quantity that the models do not read has no interval
    ]
