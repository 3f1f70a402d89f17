"""Physical bounds of each parameter of a cart and its pole, by name."""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from cartpole_rl.checking import most_similar
from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.motor import LARGEST_MOTOR


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


POSITIVE = Bound(0, math.inf, low_allowed=False)
NON_NEGATIVE = Bound(0, math.inf)
ANY = Bound(-math.inf, math.inf)
ASYMMETRY = Bound(-0.99, 0.99)
DELAY = Bound(0, 0.1)  # s; with a delay of more than five periods a pole cannot be balanced
SMALL_ANGLE = Bound(-0.2, 0.2)  # rad

BOUNDS: dict[str, Bound] = {
    "cart_mass": POSITIVE,
    "pole_mass": POSITIVE,
    "pole_com": POSITIVE,
    "pole_inertia": NON_NEGATIVE,
    "track_half_length": POSITIVE,
    "track_tilt": SMALL_ANGLE,
    "cart_viscous": NON_NEGATIVE,
    "cart_coulomb": NON_NEGATIVE,
    "cart_coulomb_asymmetry": ASYMMETRY,
    "cart_stiction_ratio": Bound(1, math.inf),
    "stribeck_velocity": POSITIVE,
    "sigmoid_slope": POSITIVE,
    "pole_viscous": NON_NEGATIVE,
    "pole_drag": NON_NEGATIVE,
    "pole_coulomb": NON_NEGATIVE,
    "force_quadratic": ANY,
    "force_linear": ANY,
    "force_offset": ANY,
    "force_asymmetry": ASYMMETRY,
    "deadband_left": Bound(0, LARGEST_MOTOR),
    "deadband_right": Bound(0, LARGEST_MOTOR),
    "motor_time_constant": DELAY,
    "latency": DELAY,
    "latency_jitter": DELAY,
    "angle_offset": SMALL_ANGLE,
    "position_noise": NON_NEGATIVE,
    "angle_noise": NON_NEGATIVE,
}


def check_names(names: Iterable[str], setting: str = "") -> None:
    """Raise ConfigError for a name that is not a parameter, with the nearest one that is.

    The message starts with the name of the `setting`, if it is given.
    """
    key = f"{setting}: " if setting else ""
    for name in names:
        if name not in BOUNDS:
            nearest = most_similar(name, BOUNDS)
            raise ConfigError(f"{key}unknown cart parameter {name!r}; did you mean {nearest!r}?")


def check_value(name: str, value: float) -> None:
    """Raise ConfigError if `value` is physically impossible for the parameter `name`."""
    if not BOUNDS[name].holds(value):
        raise ConfigError(f"{name} is {value:g}; it must be {BOUNDS[name]}")


def check_values(values: Mapping[str, float]) -> None:
    """Raise ConfigError for an unknown, missing, or physically impossible value."""
    check_names(values)
    for name in BOUNDS:
        if name not in values:
            raise ConfigError(f"the cart parameter {name!r} is missing")
        check_value(name, values[name])
