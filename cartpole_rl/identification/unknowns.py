"""The unknown numbers of a cart and their prior.

A cart is a point u with one number for each unknown, of prior mean 0 and standard deviation 1. A logarithmic
unknown multiplies its nominal value by exp(spread u); any other adds spread u.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cartpole_rl.choices import choice
from cartpole_rl.physics.models import Models, unused_parameters
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.rig.parameters import PARAMETERS, Bound, Prior, completed, factor

Array = NDArray[np.floating]
POLE_LENGTH = "pole_length"  # not a parameter of its own: see `parameters_at`
LEVELS = ("track_tilt", "angle_offset")  # last, as the posterior draws its random numbers in this order
OVERCOME = (
    "cart_mass",
    "cart_coulomb",
    "cart_coulomb_asymmetry",
    "cart_stiction_ratio",
    "stribeck_velocity",
    "track_tilt",
    "coasting",
)
WEIGHED = (POLE_LENGTH, "pole_mass")  # measured with a known pole; they set the scale of forces and masses


class Unknown(NamedTuple):
    """One number of the search: a parameter or POLE_LENGTH."""

    name: str
    prior: Prior


def unknowns_of(models: Models, known: Sequence[str] = ()) -> list[Unknown]:
    """Return the unknowns: the pole's length, and what `models` read and has a prior, without the `known`."""
    cart, *others = [Unknown(each.name, each.prior) for each in PARAMETERS.values() if each.prior]
    every = [cart, Unknown(POLE_LENGTH, factor(0.5)), *sorted(others, key=lambda each: each.name in LEVELS)]
    without = {*unused_parameters(models), *known}
    return [unknown for unknown in every if unknown.name not in without]


def hidden(nominal: Mapping[str, float]) -> tuple[str, ...]:
    """Return the unknowns that no motion shows: a stepper moves as it is told, whatever these are."""
    return () if nominal["backdrivability"] else OVERCOME


def sized(nominal: Mapping[str, float], unknowns: Sequence[Unknown]) -> dict[str, float]:
    """Return the nominal numbers; a logarithmic unknown of 0, which no factor changes, has that of ip02."""
    of_ip02 = choice("cart/ip02")
    unsized = [each.name for each in unknowns if each.prior.logarithmic and nominal.get(each.name) == 0]
    return {**nominal, **{name: of_ip02[name] for name in unsized if name in of_ip02}}


def bound_of(name: str) -> Bound:
    """Return the range of a parameter in the search."""
    bound, prior = PARAMETERS[name].bound, PARAMETERS[name].prior
    return bound if prior is None else bound._replace(high=min(bound.high, prior.largest))


LONGEST_LATENCY = bound_of("latency").high  # s


def limits(unknowns: Sequence[Unknown], nominal: Mapping[str, float]) -> tuple[Array, Array]:
    """Return the lowest and highest point, [U] each, whose parameters are within their bounds."""
    low, high = np.full(len(unknowns), -np.inf), np.full(len(unknowns), np.inf)
    for index, unknown in enumerate(unknowns):
        prior = unknown.prior
        if not prior.logarithmic:
            middle = nominal[unknown.name] if prior.middle is None else prior.middle
            bound = bound_of(unknown.name)
            low[index] = (bound.low - middle) / prior.spread
            high[index] = (bound.high - middle) / prior.spread
    return low, high


def parameters_at(points: Array, unknowns: Sequence[Unknown], nominal: Mapping[str, float]) -> Tensor:
    """Return carts [P, N] float64 at `points` [U, N], one row per parameter in the order of `CartParameters`.

    A pole of another length is the nominal one scaled: its mass and centre of mass scale with the length,
    its inertia with the cube of the length. Values stay within their bounds.
    """
    nominal = completed(nominal)
    values = {
        name: np.full(points.shape[1], float(nominal[name]), dtype=np.float64)
        for name in CartParameters.names()
    }
    for unknown, point in zip(unknowns, points, strict=True):
        prior = unknown.prior
        if unknown.name == POLE_LENGTH:
            scale = np.exp(prior.spread * point)
            for name, power in (("pole_mass", 1), ("pole_com", 1), ("pole_inertia", 3)):
                values[name] = values[name] * scale**power
        elif prior.logarithmic:
            values[unknown.name] = values[unknown.name] * np.exp(prior.spread * point)
        else:
            middle = values[unknown.name] if prior.middle is None else prior.middle
            values[unknown.name] = middle + prior.spread * point
    table = [np.clip(values[name], bound_of(name).low, bound_of(name).high) for name in values]
    return torch.from_numpy(np.stack(table))
