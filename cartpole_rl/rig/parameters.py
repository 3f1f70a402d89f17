"""The parameters of a cart: one table with all that is known about each, except its nominal value.

Everything else is derived from it: the rows of simulated carts, the checks of settings, the unknowns of an
identification and their prior, units in files and reports. A new parameter is one new entry at the end; a
law that needs one declares it among the parameters that it `reads`. Nominal values and their sources are in
``conf/cart/`` and ``conf/pole/``. A cart without a value for a parameter has its `default`.

A row of a simulated cart belongs to the entry of the same place, also in checkpoints.
"""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from cartpole_rl.checking import most_similar
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import HARDWARE, LARGEST_MOTOR, hardware_of, parameters_of


class Bound(NamedTuple):
    """The physical range of a parameter."""

    low: float
    high: float
    low_allowed: bool = True

    def holds(self, value: float) -> bool:
        """Return whether `value` is within."""
        return (value >= self.low if self.low_allowed else value > self.low) and value <= self.high

    def __str__(self) -> str:
        return f"{'at least' if self.low_allowed else 'above'} {self.low:g}" + (
            "" if math.isinf(self.high) else f" and at most {self.high:g}"
        )


class Prior(NamedTuple):
    """The knowledge of a parameter before it is identified: normal near its mean, within the bounds."""

    spread: float  # standard deviation: of the logarithm, or in the parameter's unit
    logarithmic: bool = False
    middle: float | None = None  # mean; None is the nominal value
    largest: float = math.inf  # in the search
    unusual: float = 3.0  # standard deviations from which a warning is given; infinite: never


def factor(spread: float, unusual: float = 3.0) -> Prior:
    """Return the prior of a parameter that may be exp(`spread`) times its nominal value."""
    return Prior(spread, logarithmic=True, unusual=unusual)


class Parameter(NamedTuple):
    """One parameter of a cart or its pole."""

    name: str
    unit: str
    bound: Bound
    default: float | None  # None: a cart must have a value
    prior: Prior | None  # None: it is not identified
    meaning: str
    mirrored: bool = False  # it changes its sign where left and right are swapped
    noise: bool = False  # drawn anew in each period


POSITIVE = Bound(0, math.inf, low_allowed=False)
SMALL = Bound(0, 100, low_allowed=False)  # kg, m: a larger number has another unit
NON_NEGATIVE = Bound(0, math.inf)
ANY = Bound(-math.inf, math.inf)
ASYMMETRY = Bound(-0.99, 0.99)
DELAY = Bound(0, 0.1)  # s; with a delay of more than five periods a pole cannot be balanced
SMALL_ANGLE = Bound(-0.2, 0.2)  # rad
MOTOR = Bound(0, LARGEST_MOTOR)

PARAMETERS: dict[str, Parameter] = {}


def add_parameter(parameter: Parameter) -> None:
    """Add an entry to the table. Raises ConfigError if there is another one of its name."""
    if PARAMETERS.setdefault(parameter.name, parameter) != parameter:
        raise ConfigError(f"there is another cart parameter {parameter.name!r} already: choose another name")


# stribeck_velocity is never unusual: below 1 mm/s it makes no difference
# fmt: off
for _entry in (
    Parameter("cart_mass", "kg", SMALL, None, factor(0.15),
              "mass of the cart with the motor's rotor"),
    Parameter("pole_mass", "kg", SMALL, None, factor(0.1),
              "mass of the pole"),
    Parameter("pole_com", "m", SMALL, None, None,
              "distance of the pole's centre of mass from the pivot, l in (3.5)"),
    Parameter("pole_inertia", "kg m^2", NON_NEGATIVE, None, factor(0.1),
              "inertia of the pole about its centre of mass"),
    Parameter("track_half_length", "m", SMALL, None, None,
              "middle of the track to the soft limit, where an episode ends"),
    Parameter("track_tilt", "rad", SMALL_ANGLE, 0.0, Prior(0.006),
              "tilt of the track, positive: the right end is lower", mirrored=True),
    Parameter("cart_viscous", "N s/m", NON_NEGATIVE, None, factor(1.0),
              "viscous friction of the cart, mu in (5.7)"),
    Parameter("cart_coulomb", "N", NON_NEGATIVE, None, factor(0.5),
              "Coulomb friction of the cart, mu F_norm in (5.6) and (5.8), while the pole is at rest"),
    Parameter("cart_coulomb_asymmetry", "1", ASYMMETRY, 0.0, Prior(0.15),
              "Coulomb friction is times 1 + this moving right, 1 - this moving left", mirrored=True),
    Parameter("cart_stiction_ratio", "1", Bound(1, math.inf), 1.0, Prior(0.3),
              "breakaway over Coulomb friction"),
    Parameter("stribeck_velocity", "m/s", POSITIVE, 0.01, factor(1.0, unusual=math.inf),
              "speed at which the excess of static friction has fallen to 1/e"),
    Parameter("sigmoid_slope", "s/m", POSITIVE, 100.0, None,
              "slope of the sigmoid, rho in (5.8)"),
    Parameter("pole_viscous", "N m s/rad", NON_NEGATIVE, None, factor(1.0),
              "viscous friction of the pole; alone it damps a small swing exponentially"),
    Parameter("pole_drag", "N m s^2/rad^2", NON_NEGATIVE, 0.0, factor(1.0),
              "quadratic air drag of the pole"),
    Parameter("pole_coulomb", "N m", NON_NEGATIVE, 0.0, Prior(3e-4, middle=1e-4),
              "dry friction of the pole's bearing"),
    Parameter("force_quadratic", "N per motor value squared", ANY, 0.0, None,
              "force curve, quadratic term"),
    Parameter("force_linear", "N per motor value", ANY, None, factor(0.2),
              "force curve, linear term"),
    Parameter("force_offset", "N", ANY, None, Prior(0.3),
              "force curve, constant term; negative: small motor values give no force"),
    Parameter("force_asymmetry", "1", ASYMMETRY, 0.0, Prior(0.1),
              "a force to the right is times 1 + this", mirrored=True),
    Parameter("deadband_left", "motor value", MOTOR, 0.0, None,
              "motor values up to this give no force to the left"),
    Parameter("deadband_right", "motor value", MOTOR, 0.0, None,
              "motor values up to this give no force to the right"),
    Parameter("motor_time_constant", "s", DELAY, 0.0, Prior(0.01, middle=0.008),
              "first-order lag of the force"),
    Parameter("latency", "s", DELAY, None, Prior(0.012, middle=0.012, largest=0.06),
              "from a state's measurement until the motor value chosen on it is in force"),
    Parameter("latency_jitter", "s", DELAY, 0.0, None,
              "the latency of each period is drawn from latency +- this, never below 0", noise=True),
    Parameter("angle_offset", "rad", SMALL_ANGLE, 0.0, Prior(0.012),
              "measured minus true angle: the error of the encoder's zero", mirrored=True),
    Parameter("position_noise", "m", NON_NEGATIVE, 0.0, None,
              "standard deviation of the position before quantization", noise=True),
    Parameter("angle_noise", "rad", NON_NEGATIVE, 0.0, None,
              "standard deviation of the angle before quantization", noise=True),
    Parameter("backdrivability", "1", Bound(0, 1), 1.0, None,
              "share of the pole's and gravity's force that the cart feels: 1 with a DC motor, 0 a stepper"),
    Parameter("coasting", "1", Bound(0, 1), 0.0, Prior(0.3),
              "share of the viscous friction that fades with the motor value, if an H-bridge coasts"),
):
    add_parameter(_entry)
# fmt: on


def completed(values: Mapping[str, float]) -> dict[str, float]:
    """Return `values` with the defaults of parameters that they lack."""
    defaults = {each.name: each.default for each in PARAMETERS.values() if each.default is not None}
    return {**defaults, **values}


def check_names(names: Iterable[str], setting: str = "") -> None:
    """Raise ConfigError for a name that is not a parameter, with the nearest one that is.

    The message starts with the name of the `setting`, if it is given.
    """
    key = f"{setting}: " if setting else ""
    for name in names:
        if name not in PARAMETERS:
            nearest = most_similar(name, PARAMETERS)
            raise ConfigError(f"{key}unknown cart parameter {name!r}; did you mean {nearest!r}?")


def check_value(name: str, value: float) -> None:
    """Raise ConfigError if `value` is physically impossible for the parameter `name`."""
    if not PARAMETERS[name].bound.holds(value):
        raise ConfigError(f"{name} is {value:g}; it must be {PARAMETERS[name].bound}")


def check_values(values: Mapping[str, float]) -> None:
    """Raise ConfigError for an unknown, missing, or physically impossible value."""
    check_names(values)
    values = completed(values)
    for name in PARAMETERS:
        if name not in values:
            raise ConfigError(f"the cart parameter {name!r} is missing")
        check_value(name, values[name])


def check_cart(cart: Mapping[str, float]) -> None:
    """Raise ConfigError for an unknown name in a cart's file, or an impossible number."""
    hardware_of(cart)
    for name, value in parameters_of(cart).items():
        if name not in PARAMETERS:
            nearest = most_similar(name, [*PARAMETERS, *HARDWARE])
            raise ConfigError(f"cart.{name}: there is no such setting; did you mean cart.{nearest}?")
        check_value(name, value)
