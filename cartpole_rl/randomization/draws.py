"""The interface of a source of simulated carts."""

from typing import Protocol

import torch
from torch import Tensor


class Draws(Protocol):
    """A source of carts with drawn parameters."""

    nominal: Tensor  # [P]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return parameters of `count` carts, [P, count]."""

    def ends(self, name: str, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return a draw with `name` at the low end of its range, and the same with it at the high end."""

    def longest_delay(self) -> float:
        """Return the longest latency that a draw can have, jitter included, s."""

    def can_differ_from_zero(self, name: str) -> bool:
        """Return whether a draw of `name` can be anything but 0."""
