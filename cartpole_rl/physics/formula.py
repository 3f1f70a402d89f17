"""A physics model as a choice of the settings: its name, the parameters that it reads and its formula.

Formulas use methods of tensors alone, so that settings can import models without PyTorch.
"""

from collections.abc import Callable
from enum import StrEnum
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from torch import Tensor

    from cartpole_rl.physics.parameters import CartParameters

Formula = Callable[["Tensor", "CartParameters"], "Tensor"]  # of a velocity or motor value, and the carts, [N]


def zero(of: "Tensor", cart: "CartParameters") -> "Tensor":
    """Return 0, [N]: the formula of a model without one."""
    return of.new_zeros(of.shape)


class PhysicsModel(StrEnum):
    """Base of the models of one kind. The value of a member is its name, the first of its properties."""

    reads: tuple[str, ...]  # fields of CartParameters
    formula: Formula
    sticks: bool  # a friction that holds a cart at rest

    def __new__(
        cls, name: str, reads: tuple[str, ...] = (), formula: Formula = zero, sticks: bool = False
    ) -> Self:
        """Make a member."""
        member = str.__new__(cls, name)
        member._value_, member.reads, member.formula, member.sticks = name, reads, formula, sticks
        return member
