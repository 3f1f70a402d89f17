"""Draws carts from a table of carts: what an identification found, correlations included."""

from typing import Protocol

import torch
from torch import Tensor

from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.randomizer import Randomizer


class Draws(Protocol):
    """What a simulated plant needs of what draws its carts."""

    nominal: Tensor  # [P]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Parameters of `count` carts, [P, count]."""

    def longest_delay(self) -> float:
        """The longest latency that a draw can have, jitter included, s."""

    def can_differ_from_zero(self, name: str) -> bool:
        """Whether a draw of `name` can be anything but 0."""


class FoundCarts:
    """Draws with replacement from `found` [P, M], and for `elsewhere` of all draws from `others` instead.

    It stands where a Randomizer stands; `others` keep an agent from trusting what was found too much.
    """

    def __init__(self, found: Tensor, others: Randomizer, elsewhere: float, longest_delay: float) -> None:
        self.found, self.others, self.elsewhere = found.to(others.nominal), others, elsewhere
        self._longest_delay = longest_delay  # s, of this table and of all that may take its place
        self.nominal = self.found.median(1).values

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Parameters of `count` carts, [P, count]."""
        device = self.nominal.device
        which = torch.randint(self.found.shape[1], (count,), generator=generator, device=device)
        table = self.found[:, which]
        strangers = torch.rand(count, generator=generator, device=device) < self.elsewhere
        return torch.where(strangers, self.others.draw(count, generator), table)

    def longest_delay(self) -> float:
        """The longest latency that a draw can have, jitter included, s."""
        return max(self.others.longest_delay(), self._longest_delay)

    def can_differ_from_zero(self, name: str) -> bool:
        """Whether a draw of `name` can be anything but 0."""
        row = self.found[CartParameters.names().index(name)]
        return self.others.can_differ_from_zero(name) or bool((row != 0).any())
