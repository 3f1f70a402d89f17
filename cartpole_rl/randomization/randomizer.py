"""Draws the parameters of carts: a pole, then each randomized parameter about that cart's nominal value.

A draw is a table [P, N] with a row a parameter in the order of `CartParameters.names()`, so that the rows of
finished episodes are replaced by one assignment.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from cartpole_rl.physics.parameters import CartParameters, check_names, check_values, uniform_rod
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.ranges import Distribution, Range

POLE_FIELDS = tuple(Pole.model_fields)


class Randomizer:
    """Draws carts about `cart` (every parameter but the pole's), with `poles` and `ranges` by parameter name.

    Raises ConfigError when a name is unknown, a nominal value impossible, or a range reaches an impossible one.
    """

    def __init__(
        self,
        cart: Mapping[str, float],
        poles: PoleSettings,
        ranges: Mapping[str, Range],
        device: torch.device | str = "cpu",
    ) -> None:
        names = CartParameters.names()
        self.poles, self.ranges = poles, dict(ranges)
        nominal = {**cart, **poles.nominal.model_dump()}
        check_values(nominal)
        check_names(self.ranges)
        for name, line in self.ranges.items():
            line.check(name, nominal[name])
        self.nominal = torch.tensor([float(nominal[name]) for name in names], device=device)  # [P]
        lines = [self.ranges[name] for name in self.ranges]
        self._rows = torch.tensor([names.index(name) for name in self.ranges], dtype=torch.long, device=device)
        warped = torch.tensor([line.warped() for line in lines], device=device).reshape(-1, 2)
        self._low, self._width = warped[:, :1], warped[:, 1:] - warped[:, :1]  # [R, 1] each
        self._logarithmic = self._flags([line.distribution is Distribution.LOG_UNIFORM for line in lines])
        self._scales = self._flags([line.scales_nominal for line in lines])
        self._pole_rows = [names.index(name) for name in POLE_FIELDS]
        self._choices = self.nominal.new_tensor(  # [poles, 3]
            [list(pole.model_dump().values()) for pole in (poles.choices or {"nominal": poles.nominal}).values()]
        )

    def _flags(self, values: list[bool]) -> Tensor:
        return torch.tensor(values, dtype=torch.bool, device=self.nominal.device).unsqueeze(1)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Parameters of `count` carts, [P, count]."""
        table = self.nominal.unsqueeze(1).repeat(1, count)
        table[self._pole_rows] = self._draw_poles(count, generator)
        if len(self._rows):
            unit = torch.rand((len(self._rows), count), generator=generator, device=self.nominal.device)
            value = self._low + unit * self._width
            value = torch.where(self._logarithmic, value.exp(), value)
            table[self._rows] = torch.where(self._scales, table[self._rows] * value, value)
        return table

    def _draw_poles(self, count: int, generator: torch.Generator) -> Tensor:
        """Mass, centre of mass and inertia, [3, count]."""
        if self.poles.lengths is None:
            which = torch.randint(len(self._choices), (count,), generator=generator, device=self.nominal.device)
            return self._choices[which].T
        low, high = self.poles.lengths
        rods = uniform_rod(low + (high - low) * torch.rand(count, generator=generator, device=self.nominal.device))
        return torch.stack([torch.as_tensor(rods[name]) for name in POLE_FIELDS])

    def longest_delay(self) -> float:
        """The longest latency that a draw can have, jitter included, s."""
        names = CartParameters.names()
        longest = 0.0
        for name in ("latency", "latency_jitter"):
            nominal = float(self.nominal[names.index(name)])
            line = self.ranges.get(name)
            limit = nominal if line is None else line.limits()[1] * (nominal if line.scales_nominal else 1.0)
            longest += limit
        return longest

    def can_differ(self, name: str, value: float = 0.0) -> bool:
        """Whether a draw of `name` can be anything but `value`; what stays 0 need not be simulated."""
        return name in self.ranges or float(self.nominal[CartParameters.names().index(name)]) != value
