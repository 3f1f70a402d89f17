"""Draws the parameters of carts: first a pole, then each randomized parameter about its nominal value.

A draw is a table [P, N] with rows in the order of `CartParameters.names()`, so that the rows of
finished episodes are replaced by one assignment.
"""

from collections.abc import Iterable, Mapping
from typing import Protocol

import torch
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.randomization.poles import Pole, PoleSettings, possible_poles, uniform_rod
from cartpole_rl.randomization.ranges import Range, check_carts

POLE_FIELDS = tuple(Pole.model_fields)


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


class Randomizer(Draws):
    """Draws carts about `cart` (every parameter but the pole's), with `poles` and `ranges` by parameter name.

    Raises ConfigError when a name is unknown, a nominal value is impossible, a range reaches an impossible
    value, or `cart` contains a parameter of the pole.
    """

    def __init__(
        self,
        cart: Mapping[str, float],
        poles: PoleSettings,
        ranges: Mapping[str, Range],
        device: torch.device | str = "cpu",
    ) -> None:
        self.poles, self.ranges = poles, dict(ranges)
        check_carts(cart, poles, ranges)
        nominal = {**cart, **poles.nominal.model_dump()}
        self.nominal = cart_column(nominal, torch.float32)[:, 0].to(device)
        lines = list(self.ranges.values())
        self._rows = self._row_numbers(self.ranges)
        limits = torch.tensor([line.limits() for line in lines], dtype=torch.float64, device=device)
        self._low, self._high = limits.reshape(-1, 2, 1).unbind(1)  # [R, 1] each
        self._distributions = [
            (each, self._flags([line.distribution is each for line in lines])[:, 0])
            for each in {line.distribution: None for line in lines}
        ]
        self._scales = self._flags([line.scales_nominal for line in lines])
        self._pole_rows = self._row_numbers(POLE_FIELDS)
        choices = [list(pole.model_dump().values()) for pole in possible_poles(poles)]
        self._choices = self.nominal.new_tensor(choices).T  # [3, poles]
        self._check_distributions()

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return parameters of `count` carts, [P, count]."""
        return self._table(*self._draw_parts(count, generator))

    def ends(self, name: str, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return a draw with `name` at the low end of its range, and the same with it at the high end.

        Two tables [P, count] that are equal in every other parameter. `name` must have a range.
        """
        poles, unit = self._draw_parts(count, generator)
        row = list(self.ranges).index(name)
        low, high = unit.clone(), unit.clone()
        low[row], high[row] = 0, 1
        return self._table(poles, low), self._table(poles, high)

    def longest_delay(self) -> float:
        """Return the longest latency that a draw can have, jitter included, s."""
        longest = 0.0
        for name in ("latency", "latency_jitter"):
            line, nominal = self.ranges.get(name), self._nominal_of(name)
            if line is None:
                longest += nominal
            else:
                longest += line.limits()[1] * (nominal if line.scales_nominal else 1.0)
        return longest

    def can_differ_from_zero(self, name: str) -> bool:
        """Return whether a draw of `name` can be anything but 0."""
        return name in self.ranges or self._nominal_of(name) != 0

    def _draw_parts(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return nominal carts with drawn poles, [P, count], and a number from 0 to 1 a range, [R, count]."""
        table = self.nominal.unsqueeze(1).repeat(1, count)
        if self.poles.lengths is not None or self._choices.shape[1] > 1:
            table[self._pole_rows] = self._draw_poles(count, generator)
        unit = table.new_zeros(0, count)
        if self.ranges:
            unit = torch.rand((len(self._rows), count), generator=generator, device=self.nominal.device)
        return table, unit

    def _table(self, poles: Tensor, unit: Tensor) -> Tensor:
        """Return parameters [P, N] of the carts that `_draw_parts` drew."""
        value = unit.clone()
        for distribution, lines in self._distributions:
            drawn = distribution(unit[lines], self._low[lines], self._high[lines])
            value[lines] = drawn.to(value.dtype)
        value = torch.where(self._scales, poles.index_select(0, self._rows) * value, value)
        return poles.index_copy(0, self._rows, value)

    def _draw_poles(self, count: int, generator: torch.Generator) -> Tensor:
        """Return mass, centre of mass and inertia, [3, count]."""
        device = self.nominal.device
        if self.poles.lengths is None:
            number = self._choices.shape[1]
            if self.poles.in_turn:
                return self._choices[:, torch.arange(count, device=device) % number]
            return self._choices[:, torch.randint(number, (count,), generator=generator, device=device)]
        low, high = self.poles.lengths
        rods = uniform_rod(low + (high - low) * torch.rand(count, generator=generator, device=device))
        return torch.stack([torch.as_tensor(rods[name]) for name in POLE_FIELDS])

    def _check_distributions(self) -> None:
        """Raise ConfigError for a distribution whose ends are not its bounds, or that leaves them."""
        shares = torch.tensor([0.0, 0.3, 1.0], device=self.nominal.device)
        for distribution, lines in self._distributions:
            low, high = self._low[lines], self._high[lines]
            least, value, most = distribution(shares.expand(len(low), 3), low, high).unbind(1)
            ends = torch.stack((least, most), 1).double()
            inside = ((value >= least) & (value <= most)).all()
            if not (inside and torch.allclose(ends, torch.cat((low, high), 1), rtol=1e-4, atol=1e-9)):
                raise ConfigError(
                    f"the distribution {distribution} does not run from the low to the high bound"
                )

    def _nominal_of(self, name: str) -> float:
        return float(self.nominal[CartParameters.names().index(name)])

    def _row_numbers(self, names: Iterable[str]) -> Tensor:
        fields = CartParameters.names()
        rows = [fields.index(name) for name in names]
        return torch.tensor(rows, dtype=torch.long, device=self.nominal.device)

    def _flags(self, values: list[bool]) -> Tensor:
        return torch.tensor(values, dtype=torch.bool, device=self.nominal.device).unsqueeze(1)
