"""Draws the parameters of carts: first a pole, then each randomized parameter about its nominal value.

Their initial states are drawn here, too.

A draw is a table [P, N] with rows in the order of `CartParameters.names()`, so that the rows of
finished episodes are replaced by one assignment.
"""

import math
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Protocol

import torch
from torch import Tensor

from cartpole_rl.errors import ConfigError
from cartpole_rl.physics.parameters import CartParameters, cart_column
from cartpole_rl.randomization.poles import Pole, PoleSettings, possible_poles, uniform_rod
from cartpole_rl.randomization.ranges import Range, check_carts
from cartpole_rl.tasks.settings import CENTRED, Start, StartSettings

POLE_FIELDS = tuple(Pole.model_fields)
TRIED = 1025  # shares at which a distribution is tried
START_SHARE = 0.75  # of half the track: no start is farther from the middle


class Draws(Protocol):
    """A source of carts with drawn parameters."""

    nominal: Tensor  # [P]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Return parameters of `count` carts, [P, count]."""

    def ends(self, name: str, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return a draw with `name` at the low end of its range, and the same with it at the high end."""

    def highest(self, name: str) -> float:
        """Return the highest value that a draw of `name`, a parameter of the cart, can have."""

    def longest_delay(self) -> float:
        """Return the longest latency that a draw can have, jitter included, s."""
        return self.highest("latency") + self.highest("latency_jitter")

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
        kinds = [line.distribution if line.is_plain else (name,) for name, line in self.ranges.items()]
        self._lines = [  # those drawn by one call, and their rows
            (lines[kinds.index(kind)], self._flags([each == kind for each in kinds])[:, 0])
            for kind in dict.fromkeys(kinds)
        ]
        self._mixing = self._mixing_matrix()  # [R, R], None for independent lines
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
        poles, low = self._draw_parts(count, generator)
        row, high = list(self.ranges).index(name), low.clone()
        low[row], high[row] = self._low[row].to(low.dtype), self._high[row].to(low.dtype)
        return self._table(poles, low), self._table(poles, high)

    def highest(self, name: str) -> float:
        """Return the highest value that a draw of `name`, a parameter of the cart, can have."""
        line, nominal = self.ranges.get(name), self._nominal_of(name)
        if line is None:
            return nominal
        return max(limit * (nominal if line.scales_nominal else 1.0) for limit in line.limits())

    def can_differ_from_zero(self, name: str) -> bool:
        """Return whether a draw of `name` can be anything but 0."""
        return name in self.ranges or self._nominal_of(name) != 0

    def _draw_parts(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return nominal carts with drawn poles, [P, count], and each range's value or ratio, [R, count]."""
        table = self.nominal.unsqueeze(1).repeat(1, count)
        if self.poles.lengths is not None or self._choices.shape[1] > 1:
            table[self._pole_rows] = self._draw_poles(count, generator)
        values = table.new_zeros(0, count)
        if self.ranges:
            values = self._draw_shares(count, generator)
            for line, rows in self._lines:
                drawn = line.drawn(values[rows], self._low[rows], self._high[rows])
                values[rows] = drawn.to(values.dtype)
        return table, values

    def _draw_shares(self, count: int, generator: torch.Generator) -> Tensor:
        """Return uniform numbers from 0 to 1, [R, count]: a share of each range."""
        shape, device = (len(self._rows), count), self.nominal.device
        if self._mixing is None:
            return torch.rand(shape, generator=generator, device=device)
        return torch.special.ndtr(self._mixing @ torch.randn(shape, generator=generator, device=device))

    def _table(self, poles: Tensor, values: Tensor) -> Tensor:
        """Return parameters [P, N] of the carts that `_draw_parts` drew."""
        value = torch.where(self._scales, poles.index_select(0, self._rows) * values, values)
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
        """Raise ConfigError for a distribution that fails or leaves its bounds."""
        shares = torch.linspace(0, 1, TRIED, device=self.nominal.device)
        for line, rows in self._lines:
            low, high = self._low[rows], self._high[rows]
            given = shares.expand(len(low), TRIED)
            try:
                values = torch.broadcast_to(line.drawn(given, low, high), given.shape)
            except Exception as error:
                reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
                raise ConfigError(f"the distribution {line.distribution} fails: {reason}") from None
            room = 1e-9 + 1e-4 * torch.maximum(low.abs(), high.abs())
            if not ((values >= low - room) & (values <= high + room)).all():
                raise ConfigError(f"the distribution {line.distribution} leaves its bounds")

    def _mixing_matrix(self) -> Tensor | None:
        """Return what makes correlated normal numbers of independent ones, [R, R]; None without correlations.

        Raises ConfigError for correlations that no numbers have.
        """
        names, matrix = list(self.ranges), torch.eye(len(self.ranges), dtype=torch.float64)
        for name, line in self.ranges.items():
            for other, value in line.correlation.items():
                pair = names.index(name), names.index(other)
                back = self.ranges[other].correlation.get(name, value)
                if back != value:
                    raise ConfigError(
                        f"randomization: {name} and {other} have two correlations, {value:g} and {back:g}"
                    )
                matrix[pair] = matrix[pair[::-1]] = value
        if not any(line.correlation for line in self.ranges.values()):
            return None
        size, direction = torch.linalg.eigh(matrix)
        if size.min() < -1e-6:
            raise ConfigError("randomization: the correlations contradict each other; give smaller ones")
        return (direction * size.clamp(min=0).sqrt()).to(self.nominal)

    def _nominal_of(self, name: str) -> float:
        return float(self.nominal[CartParameters.names().index(name)])

    def _row_numbers(self, names: Iterable[str]) -> Tensor:
        fields = CartParameters.names()
        rows = [fields.index(name) for name in names]
        return torch.tensor(rows, dtype=torch.long, device=self.nominal.device)

    def _flags(self, values: list[bool]) -> Tensor:
        return torch.tensor(values, dtype=torch.bool, device=self.nominal.device).unsqueeze(1)


def within_track(x: Tensor, start: StartSettings, track_half_length: Tensor) -> Tensor:
    """Return positions of starts, m, moved closer to the middle on a track that is short for their spread."""
    return x * (START_SHARE * track_half_length / start.position_spread).clamp(max=1)


def draw_start(count: int, start: StartSettings, generator: torch.Generator) -> Tensor:
    """Draw true states [count, 4]: x m, x_dot m/s, theta rad, theta_dot rad/s."""
    device = generator.device
    unit = 2 * torch.rand((count, 4), generator=generator, device=device) - 1
    state = torch.addcmul(*bounds(start, device, resting=False), unit)
    if start.resting_share == 0:
        return state
    rests = torch.rand((count, 1), generator=generator, device=device) < start.resting_share
    resting = torch.addcmul(*bounds(start, device, resting=True), unit)
    if start.centred_share > 0:
        centred = torch.rand((count, 1), generator=generator, device=device) < start.centred_share
        near = min(CENTRED, start.position_spread) * unit[:, :1]
        resting[:, :1] = torch.where(centred, near, resting[:, :1])
    return torch.where(rests, resting, state)


@cache
def bounds(start: StartSettings, device: torch.device, resting: bool) -> tuple[Tensor, Tensor]:
    """Return centre and spread [4] of the initial states; with `resting`, of those at rest."""
    angle, angle_spread = {
        Start.UPRIGHT: (0.0, start.angle_spread),
        Start.HANGING: (math.pi, start.angle_spread),
        Start.ANY: (0.0, math.pi),
    }[start.angle]
    spread = [start.position_spread, start.speed_spread, angle_spread, start.angular_speed_spread]
    if resting:
        angle, spread = math.pi, [start.position_spread, 0.0, 0.0, 0.0]
    return torch.tensor([0.0, 0.0, angle, 0.0], device=device), torch.tensor(spread, device=device)
