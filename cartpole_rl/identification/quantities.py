"""An identified cart in quantities that motion shows: ratios to the moving mass, times, angles."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.identification.fit import Fit
from cartpole_rl.intervals import CONFIDENCE
from cartpole_rl.physics.parameters import GRAVITY, CartParameters

Array = NDArray[np.floating]
TYPICAL = 5.0  # rad/s, the speed of a wide swing, for which the pole's damping is given


class Quantity(NamedTuple):
    """One quantity, with its interval."""

    name: str
    words: str
    unit: str
    value: float
    low: float = math.nan  # of its 95 % interval
    high: float = math.nan

    @property
    def interval(self) -> tuple[float, float, float]:
        """Value, low, high."""
        return self.value, self.low, self.high


def quantities(cart: Mapping[str, float]) -> list[Quantity]:
    """Return the quantities of one cart, from its parameters. The force is that about motor value 200."""
    mass = cart["cart_mass"] + cart["pole_mass"]
    moment = cart["pole_mass"] * cart["pole_com"]
    inertia = cart["pole_inertia"] + moment * cart["pole_com"]
    gain = cart["force_linear"] + 400 * cart["force_quadratic"]
    damping = (
        cart["pole_viscous"] * TYPICAL + cart["pole_drag"] * TYPICAL**2 + cart["pole_coulomb"]
    ) / inertia
    return [
        Quantity(
            "pole_frequency",
            "frequency of the pole's small swing",
            "Hz",
            math.sqrt(moment * GRAVITY / inertia) / (2 * math.pi),
        ),
        Quantity("pole_damping", f"damping of the pole at {TYPICAL:g} rad/s", "rad/s^2", damping),
        Quantity(
            "force_gain",
            "motor: force per motor value over mass",
            "mm/s^2",
            1e3 * gain * (1 + cart["force_asymmetry"] / 2) / mass,
        ),
        Quantity("force_asymmetry", "motor: more force to the right by", "%", 100 * cart["force_asymmetry"]),
        Quantity("deadband", "motor: no force up to motor value", "", no_force_up_to(cart)),
        Quantity("viscous", "cart: viscous friction over mass", "1/s", cart["cart_viscous"] / mass),
        Quantity("coulomb", "cart: Coulomb friction over mass", "m/s^2", cart["cart_coulomb"] / mass),
        Quantity(
            "coulomb_asymmetry",
            "cart: more Coulomb friction to the right by",
            "%",
            200 * cart["cart_coulomb_asymmetry"],
        ),
        Quantity("stiction", "cart: breakaway over Coulomb friction", "", cart["cart_stiction_ratio"]),
        Quantity("latency", "latency", "ms", 1e3 * cart["latency"]),
        Quantity("lag", "motor: time constant", "ms", 1e3 * cart["motor_time_constant"]),
        Quantity("tilt", "track: the right end is lower by", "deg", math.degrees(cart["track_tilt"])),
        Quantity(
            "angle_offset", "pole: measured minus true angle", "deg", math.degrees(cart["angle_offset"])
        ),
    ]


def no_force_up_to(cart: Mapping[str, float]) -> float:
    """Return the motor value up to which there is no force: the dead-bands' mean, or the curve's zero."""
    a, b, c = (cart[f"force_{name}"] for name in ("quadratic", "linear", "offset"))
    zero = -c / b if abs(a) < 1e-12 else (-b + math.sqrt(max(0.0, b * b - 4 * a * c))) / (2 * a)
    return (max(zero, cart["deadband_left"]) + max(zero, cart["deadband_right"])) / 2


def intervals(fit: Fit, carts: Array) -> list[Quantity]:
    """Return the quantities that were identified, with 95 % intervals of carts [P, N] drawn from the fit."""
    names = CartParameters.names()
    drawn = [quantities(dict(zip(names, cart.tolist(), strict=True))) for cart in carts.T]
    tail = 100 * (1 - CONFIDENCE) / 2
    identified = []
    for index, each in enumerate(quantities(fit.parameters)):
        low, high = np.percentile([quantity[index].value for quantity in drawn], [tail, 100 - tail])
        if high > low:  # a quantity that the models do not read has no interval
            identified.append(each._replace(low=float(low), high=float(high)))
    return identified
