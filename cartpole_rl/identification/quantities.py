"""An identified cart in quantities that motion shows: ratios to the moving mass, times, angles."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.identification.fit import Fit
from cartpole_rl.physics.parameters import GRAVITY, CartParameters
from cartpole_rl.settings import CONFIDENCE

Array = NDArray[np.floating]
TYPICAL = 5.0  # rad/s, the speed of a wide swing, for which the pole's damping is given


WORDS = {  # name: words, unit
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
