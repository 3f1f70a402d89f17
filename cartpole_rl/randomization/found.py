"""Draws carts from a table of carts: what an identification found, correlations included."""

from collections.abc import Collection, Mapping
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.bounds import BOUNDS
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.settings import FoundSettings


class Draws(Protocol):
    """What a simulated plant needs of what draws its carts."""

    nominal: Tensor  # [P]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Parameters of `count` carts, [P, count]."""

    def ends(self, name: str, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A draw with `name` at the low end of its range, and the same draw with it at the high end."""

    def longest_delay(self) -> float:
        """The longest latency that a draw can have, jitter included, s."""

    def can_differ_from_zero(self, name: str) -> bool:
        """Whether a draw of `name` can be anything but 0."""


LATENCY = CartParameters.names().index("latency")


class FoundCarts:
    """Draws with replacement from `found` [P, M], and for `prior_share` of all draws from `others` instead.

    It stands where a Randomizer stands; `others` keep an agent from trusting what was found too much. Of the
    parameters that are not `told` every draw is the others'; None tells all. Raises ConfigError for a number
    that is not finite.
    """

    def __init__(
        self,
        found: Tensor,
        others: Draws,
        prior_share: float,
        longest_delay: float,
        told: Collection[str] | None = None,
    ) -> None:
        if not found.isfinite().all():
            row = int((~found.isfinite()).any(1).nonzero()[0])
            raise ConfigError(f"carts to draw from: {CartParameters.names()[row]} is not finite")
        self.found, self.others, self.prior_share = found.to(others.nominal), others, prior_share
        telling = [told is None or name in told for name in CartParameters.names()]
        self._told = torch.tensor(telling, device=self.found.device).unsqueeze(1)
        self._longest_delay = longest_delay  # s, of this table and of all that may take its place
        self.nominal = self.found.median(1).values

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Parameters of `count` carts, [P, count]."""
        table, keeps = self._draw_found(count, generator, self.prior_share)
        return torch.where(keeps, table, self.others.draw(count, generator))

    def ends(self, name: str, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A draw with `name` at the low end of its range, and the same draw with it at the high end.

        Two tables [P, count], equal where a cart has what was found of `name`. Where a share of the carts
        comes from elsewhere, at least half do here, so that a small share is not overlooked.
        """
        table, keeps = self._draw_found(
            count, generator, max(self.prior_share, 0.5) if self.prior_share else 0.0
        )
        low, high = self.others.ends(name, count, generator)
        return torch.where(keeps, table, low), torch.where(keeps, table, high)

    def _draw_found(
        self, count: int, generator: torch.Generator, prior_share: float
    ) -> tuple[Tensor, Tensor]:
        """Carts of `found` [P, count], and which of their numbers are kept, [P, count] bool.

        All numbers of a share `prior_share` of the carts are given up.
        """
        device = self.nominal.device
        which = torch.randint(self.found.shape[1], (count,), generator=generator, device=device)
        strangers = torch.rand(count, generator=generator, device=device) < prior_share
        return self.found[:, which], self._told & ~strangers

    def longest_delay(self) -> float:
        """The longest latency that a draw can have, jitter included, s."""
        return max(self.others.longest_delay(), self._longest_delay)

    def can_differ_from_zero(self, name: str) -> bool:
        """Whether a draw of `name` can be anything but 0."""
        row = self.found[CartParameters.names().index(name)]
        return self.others.can_differ_from_zero(name) or bool((row != 0).any())


def found_carts(settings: FoundSettings, cart: Mapping[str, float], poles: PoleSettings) -> FoundCarts:
    """What draws the carts of `settings`. Raises ConfigError where the file is missing or damaged."""
    others = Randomizer(cart, poles, settings.ranges)
    try:
        with np.load(settings.posterior) as stored:
            table = dict(zip(stored["names"].tolist(), stored["carts"], strict=True))
            told = [str(name) for name in stored["told"]]
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(f"randomization.posterior={settings.posterior} cannot be read: {error}") from None
    rows = []
    for name, usual in zip(CartParameters.names(), others.nominal.tolist(), strict=True):
        values = np.asarray(table.get(name, [usual]), dtype=np.float64)
        values = np.median(values) + settings.widen * (values - np.median(values))
        rows.append(np.clip(values, BOUNDS[name].low, BOUNDS[name].high))
    found = torch.from_numpy(np.stack(np.broadcast_arrays(*rows))).float()
    return FoundCarts(found, others, settings.prior_share, float(found[LATENCY].max()), told)
