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

from cartpole_rl.physics.bounds import BOUNDS, Bound
from cartpole_rl.physics.models import Models, unused_parameters
from cartpole_rl.physics.parameters import CartParameters

Array = NDArray[np.floating]
LONGEST_LATENCY = 0.06  # s, in the search
POLE_LENGTH = "pole_length"  # not a field of CartParameters: see `parameters_at`


class Unknown(NamedTuple):
    """One number of the search."""

    name: str  # of CartParameters, or POLE_LENGTH
    spread: float  # prior standard deviation: of the logarithm, or in the parameter's unit
    logarithmic: bool = False
    middle: float | None = None  # prior mean; None is the nominal value


UNKNOWNS: tuple[Unknown, ...] = (
    Unknown("cart_mass", 0.15, logarithmic=True),
    Unknown(POLE_LENGTH, 0.5, logarithmic=True),
    Unknown("pole_mass", 0.1, logarithmic=True),
    Unknown("pole_inertia", 0.1, logarithmic=True),
    Unknown("cart_viscous", 1.0, logarithmic=True),
    Unknown("cart_coulomb", 0.5, logarithmic=True),
    Unknown("cart_coulomb_asymmetry", 0.15),
    Unknown("cart_stiction_ratio", 0.3),
    Unknown("stribeck_velocity", 1.0, logarithmic=True),
    Unknown("pole_viscous", 1.0, logarithmic=True),
    Unknown("pole_drag", 1.0, logarithmic=True),
    Unknown("pole_coulomb", 3e-4, middle=1e-4),
    Unknown("force_linear", 0.2, logarithmic=True),
    Unknown("force_offset", 0.3),
    Unknown("force_asymmetry", 0.1),
    Unknown("motor_time_constant", 0.01, middle=0.008),
    Unknown("latency", 0.012, middle=0.012),
    Unknown("track_tilt", 0.006),
    Unknown("angle_offset", 0.012),
)


WEIGHED = (POLE_LENGTH, "pole_mass")  # measured with a known pole; they set the scale of forces and masses


def unknowns_of(models: Models, known: Sequence[str] = ()) -> list[Unknown]:
    """Return the unknowns that the chosen models read and that are not `known`."""
    without = {*unused_parameters(models), *known}
    return [unknown for unknown in UNKNOWNS if unknown.name not in without]


def bound_of(name: str) -> Bound:
    """Return the range of a parameter in the search."""
    return Bound(0, LONGEST_LATENCY) if name == "latency" else BOUNDS[name]


def limits(unknowns: Sequence[Unknown], nominal: Mapping[str, float]) -> tuple[Array, Array]:
    """Return the lowest and highest point, [U] each, whose parameters are within their bounds."""
    low, high = np.full(len(unknowns), -np.inf), np.full(len(unknowns), np.inf)
    for index, unknown in enumerate(unknowns):
        if not unknown.logarithmic:
            middle = nominal[unknown.name] if unknown.middle is None else unknown.middle
            bound = bound_of(unknown.name)
            low[index] = (bound.low - middle) / unknown.spread
            high[index] = (bound.high - middle) / unknown.spread
    return low, high


def parameters_at(points: Array, unknowns: Sequence[Unknown], nominal: Mapping[str, float]) -> Tensor:
    """Return carts [P, N] float64 at `points` [U, N], one row per parameter in the order of `CartParameters`.

    A pole of another length is the nominal one scaled: its mass and centre of mass scale with the length,
    its inertia with the cube of the length. Values stay within their bounds.
    """
    values = {
        name: np.full(points.shape[1], float(nominal[name]), dtype=np.float64)
        for name in CartParameters.names()
    }
    for unknown, point in zip(unknowns, points, strict=True):
        if unknown.name == POLE_LENGTH:
            scale = np.exp(unknown.spread * point)
            for name, power in (("pole_mass", 1), ("pole_com", 1), ("pole_inertia", 3)):
                values[name] = values[name] * scale**power
        elif unknown.logarithmic:
            values[unknown.name] = values[unknown.name] * np.exp(unknown.spread * point)
        else:
            middle = values[unknown.name] if unknown.middle is None else unknown.middle
            values[unknown.name] = middle + unknown.spread * point
    table = [np.clip(values[name], bound_of(name).low, bound_of(name).high) for name in values]
    return torch.from_numpy(np.stack(table))
