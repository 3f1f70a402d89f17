"""Parameters of N carts and their poles: the table of `cartpole_rl.rig.parameters`, in numbers.

Every parameter is a tensor [N], float32 or float64, in SI units; N is the number of carts. One cart is a
batch of one. What can be derived (total mass, pivot inertia) is a property, so it cannot go stale.
"""

from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor

from cartpole_rl.rig.parameters import PARAMETERS, completed

GRAVITY = 9.81  # m/s^2


class CartParameters:
    """N carts: masses, friction, actuator, delays and sensors, one attribute for each parameter, [N].

    Immutable: rows of `table` [P, N], whose memory they share.
    """

    table: Tensor

    def __init__(self, table: Tensor) -> None:
        if len(table) > len(PARAMETERS):
            raise ValueError(f"{len(table)} rows, but only {len(PARAMETERS)} parameters are known")
        vars(self).update(zip(PARAMETERS, table.unbind(0), strict=False), table=table)

    def __getattr__(self, name: str) -> Tensor:
        raise AttributeError(f"carts have no parameter {name!r}")

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name} cannot be set: carts are immutable")

    def clone(self) -> Self:
        """Return the same carts in memory of their own."""
        return type(self)(self.table.clone())

    @staticmethod
    def names() -> tuple[str, ...]:
        """Return the names of the rows of a table."""
        return tuple(PARAMETERS)

    @property
    def total_mass(self) -> Tensor:
        """Cart and pole, kg, [N]."""
        return self.cart_mass + self.pole_mass

    @property
    def driven_mass(self) -> Tensor:
        """The accelerated mass, kg, [N]: a motor that cannot be driven back does not feel the pole."""
        return self.cart_mass + self.backdrivability * self.pole_mass

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


def cart_column(values: Mapping[str, float], dtype: torch.dtype = torch.float64) -> Tensor:
    """Return the table [P, 1] of one cart from its parameters by name."""
    values = completed(values)
    return torch.tensor([[float(values[name])] for name in PARAMETERS], dtype=dtype)
