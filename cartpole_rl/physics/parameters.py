"""The parameters of a batch of carts, and of the poles they carry.

Every field is a tensor of shape [N], float32 or float64, in SI units; N is the number of carts. One cart is a
batch of one. What can be derived (total mass, pivot inertia) is a property, so it cannot go stale.
"""

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple, Self

from tensordict import TensorClass
from torch import Tensor

from cartpole_rl.errors import ConfigError

GRAVITY = 9.81  # m/s^2

# The thesis's (6.4). Quanser's poles have half of it, 0.127 kg on 0.3365 m and 0.230 kg on 0.6413 m: 0.7 kg/m
# is their mass over the distance from pivot to centre of mass.
POLE_DENSITY = 0.7  # kg/m


class CartParameters(TensorClass["frozen", "tensor_only"]):  # type: ignore[name-defined]
    """N carts: masses, friction, actuator, and what stands between the state and the host.

    Nominal numbers and their sources are in ``conf/cart/ip02.yaml`` and ``conf/pole/``.
    """

    cart_mass: Tensor  # kg, the motor's rotor counted in: only the sum moves
    pole_mass: Tensor  # kg
    pole_com: Tensor  # m, pivot to centre of mass; the l of equation (3.5)
    pole_inertia: Tensor  # kg m^2, about the centre of mass
    track_half_length: Tensor  # m, middle of the track to the soft limit, where an episode ends
    track_tilt: Tensor  # rad, positive: the right end is lower

    cart_viscous: Tensor  # N s/m, the mu of (5.7)
    cart_coulomb: Tensor  # N, mu * F_norm of (5.6) and (5.8) on a resting pole
    cart_coulomb_asymmetry: Tensor  # 1, Coulomb friction is (1 + it) moving right, (1 - it) moving left
    cart_stiction_ratio: Tensor  # 1, breakaway / Coulomb friction (Stribeck only)
    stribeck_velocity: Tensor  # m/s, where the excess of static friction has fallen to 1/e
    sigmoid_slope: Tensor  # s/m, the rho of (5.8)

    pole_viscous: Tensor  # N m s/rad; alone it gives the exponential decay of a small swing
    pole_drag: Tensor  # N m s^2/rad^2, quadratic air drag
    pole_coulomb: Tensor  # N m, dry friction of the bearing

    force_quadratic: Tensor  # N per motor value squared
    force_linear: Tensor  # N per motor value
    force_offset: Tensor  # N, negative: the force that small motor values lack
    force_asymmetry: Tensor  # 1, a force to the right is (1 + it) times as large
    deadband_left: Tensor  # motor values up to this give no force to the left
    deadband_right: Tensor  # motor values up to this give no force to the right
    motor_time_constant: Tensor  # s, first-order lag of the force
    latency: Tensor  # s, from a state's measurement until the motor value chosen on it is in force
    latency_jitter: Tensor  # s, the latency of each period is drawn from latency +- this, never below 0

    angle_offset: Tensor  # rad, measured minus true angle: the zero was set off the vertical
    position_noise: Tensor  # m, standard deviation before quantization
    angle_noise: Tensor  # rad, standard deviation before quantization

    @property
    def total_mass(self) -> Tensor:
        """Cart and pole, kg, [N]."""
        return self.cart_mass + self.pole_mass

    @property
    def first_moment(self) -> Tensor:
        """m_p l, kg m, [N]."""
        return self.pole_mass * self.pole_com

    @property
    def pivot_inertia(self) -> Tensor:
        """Inertia of the pole about its pivot, kg m^2, [N] (parallel axes)."""
        return self.pole_inertia + self.pole_mass * self.pole_com**2

    @property
    def pole_length(self) -> Tensor:
        """Length of the uniform rod with the same centre of mass, 2 l, m, [N]; the thesis's "length"."""
        return 2 * self.pole_com

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The fields, in order."""
        return tuple(field.name for field in dataclasses.fields(cls))

    @classmethod
    def from_table(cls, table: Tensor) -> Self:
        """N carts from `table` [P, N], a row a field in the order of `names`; the fields share its memory."""
        return cls(**dict(zip(cls.names(), table.unbind(0), strict=True)), batch_size=[table.shape[1]])


class Bound(NamedTuple):
    """What a parameter can physically be."""

    low: float
    high: float
    low_allowed: bool = True

    def holds(self, value: float) -> bool:
        """Whether `value` is within."""
        return (value >= self.low if self.low_allowed else value > self.low) and value <= self.high

    def __str__(self) -> str:
        return f"{'at least' if self.low_allowed else 'above'} {self.low:g}" + (
            "" if math.isinf(self.high) else f" and at most {self.high:g}"
        )


POSITIVE = Bound(0, math.inf, low_allowed=False)
NON_NEGATIVE = Bound(0, math.inf)
ANY = Bound(-math.inf, math.inf)
LESS_THAN_ALL = Bound(-0.99, 0.99)
DELAY = Bound(0, 0.1)  # s; more than five periods is no cart that one can balance
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
    "cart_coulomb_asymmetry": LESS_THAN_ALL,
    "cart_stiction_ratio": Bound(1, math.inf),
    "stribeck_velocity": POSITIVE,
    "sigmoid_slope": POSITIVE,
    "pole_viscous": NON_NEGATIVE,
    "pole_drag": NON_NEGATIVE,
    "pole_coulomb": NON_NEGATIVE,
    "force_quadratic": ANY,
    "force_linear": ANY,
    "force_offset": ANY,
    "force_asymmetry": LESS_THAN_ALL,
    "deadband_left": Bound(0, 255),
    "deadband_right": Bound(0, 255),
    "motor_time_constant": DELAY,
    "latency": DELAY,
    "latency_jitter": DELAY,
    "angle_offset": SMALL_ANGLE,
    "position_noise": NON_NEGATIVE,
    "angle_noise": NON_NEGATIVE,
}


def check_names(names: Iterable[str]) -> None:
    """Raise ConfigError for a name that is no parameter, with the nearest one that is."""
    for name in names:
        if name not in BOUNDS:
            nearest = difflib.get_close_matches(name, BOUNDS, n=1, cutoff=0)[0]
            raise ConfigError(f"unknown cart parameter {name!r}; did you mean {nearest!r}?")


def check_values(values: Mapping[str, float]) -> None:
    """Raise ConfigError for an unknown, missing, or physically impossible value."""
    check_names(values)
    for name, bound in BOUNDS.items():
        if name not in values:
            raise ConfigError(f"the cart parameter {name!r} is missing")
        if not bound.holds(values[name]):
            raise ConfigError(f"{name} is {values[name]:g}; it must be {bound}")


def uniform_rod(length: Tensor | float) -> dict[str, Tensor | float]:
    """Mass, centre of mass and inertia of a rod of `length` m and POLE_DENSITY: one choice sets all three."""
    mass = POLE_DENSITY * length
    return {"pole_mass": mass, "pole_com": length / 2, "pole_inertia": mass * length**2 / 12}
