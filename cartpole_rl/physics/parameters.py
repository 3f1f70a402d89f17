"""The parameters of a batch of carts, and of the poles they carry.

Every field is a tensor of shape [N], float32 or float64, in SI units; N is the number of carts. One cart is a
batch of one. What can be derived (total mass, pivot inertia) is a property, so it cannot go stale.
"""

import dataclasses
from typing import Self

from tensordict import TensorClass
from torch import Tensor

GRAVITY = 9.81  # m/s^2


class CartParameters(TensorClass["frozen", "tensor_only"]):  # type: ignore[name-defined]
    """N carts: masses, friction, actuator, delays and sensors.

    Nominal numbers and their sources are in ``conf/cart/ip02.yaml`` and ``conf/pole/``.
    """

    cart_mass: Tensor  # kg, including the motor's rotor
    pole_mass: Tensor  # kg
    pole_com: Tensor  # m, pivot to centre of mass; the l of equation (3.5)
    pole_inertia: Tensor  # kg m^2, about the centre of mass
    track_half_length: Tensor  # m, middle of the track to the soft limit, where an episode ends
    track_tilt: Tensor  # rad, positive: the right end is lower

    cart_viscous: Tensor  # N s/m, the mu of (5.7)
    cart_coulomb: Tensor  # N, mu * F_norm of (5.6) and (5.8) on a resting pole
    cart_coulomb_asymmetry: Tensor  # 1, Coulomb friction times 1 + this moving right, 1 - this left
    cart_stiction_ratio: Tensor  # 1, breakaway / Coulomb friction (Stribeck only)
    stribeck_velocity: Tensor  # m/s, where the excess of static friction has fallen to 1/e
    sigmoid_slope: Tensor  # s/m, the rho of (5.8)

    pole_viscous: Tensor  # N m s/rad; alone it gives the exponential decay of a small swing
    pole_drag: Tensor  # N m s^2/rad^2, quadratic air drag
    pole_coulomb: Tensor  # N m, dry friction of the bearing

    force_quadratic: Tensor  # N per motor value squared
    force_linear: Tensor  # N per motor value
    force_offset: Tensor  # N, negative: the force curve is zero for small motor values
    force_asymmetry: Tensor  # 1, a force to the right is 1 + this times as large
    deadband_left: Tensor  # motor values up to this give no force to the left
    deadband_right: Tensor  # motor values up to this give no force to the right
    motor_time_constant: Tensor  # s, first-order lag of the force
    latency: Tensor  # s, from a state's measurement until the motor value chosen on it is in force
    latency_jitter: Tensor  # s, the latency of each period is drawn from latency +- this, never below 0

    angle_offset: Tensor  # rad, measured minus true angle: the error of the encoder's zero
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
        """Return the fields, in order."""
        return tuple(field.name for field in dataclasses.fields(cls))

    @classmethod
    def from_table(cls, table: Tensor) -> Self:
        """Return N carts from `table` [P, N], one row per field in the order of `names`, sharing memory."""
        return cls(**dict(zip(cls.names(), table.unbind(0), strict=True)), batch_size=[table.shape[1]])
