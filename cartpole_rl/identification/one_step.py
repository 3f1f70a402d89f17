"""Parameters from single transitions, as the thesis estimates them (6.5.1, figure 6.15).

Least squares on (s_t, a_t, s_{t+1}): the parameters with which one Euler step (3.8) over a control period
predicts the next measured state best. It is here for comparison. The same quantized sample stands on both
sides, velocities are differences that lag by half a period, and a delay is missing: see `fit` for a
regression without these errors.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.physics.dynamics import State, advance, mechanism
from cartpole_rl.physics.friction import viscous_share
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.tasks.episode import Episode

Array = NDArray[np.float64]
MASSES = ("cart_mass", "pole_mass", "pole_com")  # figure 6.15a: all others are known
FRICTION_AND_FORCE = (  # figure 6.15b
    "cart_coulomb",
    "pole_viscous",
    "force_quadratic",
    "force_linear",
    "force_offset",
)


class Estimate(NamedTuple):
    """An estimated parameter with its standard error by the regression; infinite if it is undetermined."""

    value: float
    error: float


class Transitions(NamedTuple):
    """Measured transitions: motor values [N], states [4, N] before and [4, N] after."""

    motor: Tensor
    before: Tensor
    after: Tensor


def one_step_estimates(
    episodes: Sequence[Episode], nominal: Mapping[str, float], models: Models, period: float
) -> dict[str, Estimate]:
    """Return MASSES and FRICTION_AND_FORCE, each group with all other parameters at their nominal values.

    The search starts at the nominal cart and has no bounds, as `scipy.optimize.curve_fit` in the thesis.
    """
    data = transitions(episodes)
    return {
        name: estimate
        for names in (MASSES, FRICTION_AND_FORCE)
        for name, estimate in regression(data, nominal, models, period, names).items()
    }


def transitions(episodes: Sequence[Episode]) -> Transitions:
    """Return all transitions of the episodes."""
    states = [
        np.stack([getattr(each, name)[: each.measured_steps + 1] for name in State._fields])
        for each in episodes
    ]
    motor = np.concatenate([each.motor[: each.measured_steps] for each in episodes])
    before = np.concatenate([each[:, :-1] for each in states], 1)
    after = np.concatenate([each[:, 1:] for each in states], 1)
    return Transitions(*(torch.from_numpy(each.astype(np.float64)) for each in (motor, before, after)))


def regression(
    data: Transitions, nominal: Mapping[str, float], models: Models, period: float, names: Sequence[str]
) -> dict[str, Estimate]:
    """Return the least-squares estimates of the parameters `names`."""
    from scipy.optimize import least_squares  # slow to import

    start = np.array([nominal[name] for name in names])
    scale = np.where(start == 0, 1e-6, np.abs(start))  # force_quadratic is 0

    def residuals(point: Array) -> Array:
        values = {**nominal, **dict(zip(names, (start + scale * point).tolist(), strict=True))}
        return (predicted(data, values, models, period) - data.after).numpy().ravel()

    found = least_squares(residuals, np.zeros(len(names)), method="lm")
    spread = np.sqrt(2 * found.cost / max(1, found.fun.size - len(names)))
    _, sizes, vectors = np.linalg.svd(found.jac, full_matrices=False)
    with np.errstate(divide="ignore"):
        errors = spread * scale * np.sqrt(((vectors.T / sizes) ** 2).sum(1))
    estimates = start + scale * found.x
    return {
        name: Estimate(value, error)
        for name, value, error in zip(names, estimates.tolist(), errors.tolist(), strict=True)
    }


def predicted(data: Transitions, values: Mapping[str, float], models: Models, period: float) -> Tensor:
    """Return the states [4, N] one Euler step after `data.before`, of a uniform rod (k = 1/3 in (3.5))."""
    rod = {**values, "pole_inertia": values["pole_mass"] * values["pole_com"] ** 2 / 3}
    cart = CartParameters(cart_column(rod))
    force = models.actuator(data.motor, cart)
    share = viscous_share(data.motor, cart)
    return torch.stack(advance(State(*data.before), force, cart, mechanism(cart), models, period, share))
