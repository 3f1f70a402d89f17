"""Randomization as data: for each parameter one line with a distribution and its bounds.

Bounds are `absolute` (the value itself), `relative` (nominal * (1 + bound)) or `factor` (nominal * bound).
"""

from collections.abc import Mapping
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ConfigDict, Field, model_validator

from cartpole_rl.errors import ConfigError
from cartpole_rl.randomization.distributions import DISTRIBUTIONS, PLACES, Distribution
from cartpole_rl.randomization.poles import Pole, PoleSettings, possible_poles
from cartpole_rl.rig.parameters import PARAMETERS, check_names, check_values, completed
from cartpole_rl.settings import Finite, Fraction, Positive, Settings

if TYPE_CHECKING:
    from torch import Tensor

Bounds = Annotated[tuple[Finite, ...], Field(min_length=2)]  # [low, high]; values of a discrete distribution
Correlation = Annotated[float, Field(ge=-1, le=1)]


class Range(Settings):
    """Distribution with its keywords, and exactly one kind of bounds; or a `mixture` of such lines.

    `correlation` with other parameters is that of the normal scores of their shares.
    """

    model_config = ConfigDict(extra="allow")  # the keywords of the distribution
    distribution: Annotated[Distribution, DISTRIBUTIONS] = DISTRIBUTIONS.find("uniform")
    absolute: Bounds | None = None
    relative: Bounds | None = None
    factor: Bounds | None = None
    mixture: tuple["Range", ...] | None = None
    weights: tuple[Positive, ...] | None = None  # of a mixture or of discrete values; None: all alike
    correlation: dict[str, Correlation] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _is_consistent(self) -> "Range":
        if self.mixture is None:
            return self._is_one_line()
        if len(self.mixture) < 2:
            raise ValueError("a mixture takes two or more lines")
        if self._given or self.model_extra or self.distribution != "uniform":
            raise ValueError("a mixture has bounds and distributions in its lines alone")
        if len({line.scales_nominal for line in self.mixture}) > 1:
            raise ValueError("the lines of a mixture are all absolute, or none is")
        if any(line.correlation for line in self.mixture):
            raise ValueError("give correlation beside mixture, not in its lines")
        self._check_weights(len(self.mixture))
        return self

    def _is_one_line(self) -> "Range":
        try:
            shape = self.distribution.shape(self._keywords)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        if len(self._given) != 1:
            raise ValueError("give exactly one of absolute, relative, factor, or a mixture")
        bounds = self._given[0]
        if self.distribution.listed:
            self._check_weights(len(bounds))
        elif len(bounds) != 2:
            raise ValueError(f"bounds {list(bounds)}: {self.distribution} takes two, [low, high]")
        elif bounds[0] > bounds[1]:
            raise ValueError(f"bounds {list(bounds)} are in the wrong order")
        for name in PLACES:
            if shape.get(name) is not None and not min(bounds) <= shape[name] <= max(bounds):
                raise ValueError(f"{name} {shape[name]:g} is outside the bounds {list(bounds)}")
        return self

    def _check_weights(self, count: int) -> None:
        if self.weights is not None and len(self.weights) != count:
            raise ValueError(f"give {count} weights, not {len(self.weights)}")

    @property
    def _given(self) -> list[tuple[float, ...]]:
        return [bounds for bounds in (self.absolute, self.relative, self.factor) if bounds is not None]

    @property
    def _keywords(self) -> dict[str, Any]:
        weights = {} if self.weights is None else {"weights": self.weights}
        return {**(self.model_extra or {}), **weights}

    @property
    def is_plain(self) -> bool:
        """Bounds and the name of the distribution describe the line."""
        return not (self._keywords or self.mixture or self.distribution.listed)

    @property
    def scales_nominal(self) -> bool:
        """The drawn value is a multiple of the nominal one."""
        return self.mixture[0].scales_nominal if self.mixture else self.absolute is None

    def limits(self) -> tuple[float, float]:
        """Return the lowest and the highest value (absolute), or ratio to the nominal one."""
        if self.mixture:
            low, high = zip(*(line.limits() for line in self.mixture), strict=True)
            return min(low), max(high)
        values = [self._offset + bound for bound in self._given[0]]
        return min(values), max(values)

    @property
    def _offset(self) -> float:
        return 1.0 if self.relative is not None else 0.0

    def drawn(self, share: "Tensor", low: "Tensor", high: "Tensor") -> "Tensor":
        """Return values [R, N] of shares [R, N], 0 to 1, within limits [R, 1] float64."""
        if self.mixture:
            return self._drawn_mixture(share, low)
        values: Tensor = self.distribution(share, low, high, **self._shape)
        return values

    @cached_property
    def _shape(self) -> dict[str, Any]:
        """The keywords of the distribution, in the terms of the limits."""
        shape = self.distribution.shape(self._keywords)
        shape |= {name: self._offset + shape[name] for name in PLACES if shape.get(name) is not None}
        if self.distribution.listed:
            shape["values"] = [self._offset + value for value in self._given[0]]
        return shape

    def _drawn_mixture(self, share: "Tensor", like: "Tensor") -> "Tensor":
        """Return values of shares: each line has a part of the shares, as wide as its weight."""
        assert self.mixture
        weights = self.weights or (1.0,) * len(self.mixture)
        edges = [0.0, *accumulate(weight / sum(weights) for weight in weights)]
        values = like.new_zeros(share.shape)
        for line, (start, stop) in zip(self.mixture, pairwise(edges), strict=True):
            part = ((share - start) / (stop - start)).clamp(0, 1)
            low, high = like.new_tensor(line.limits()).reshape(2, 1, 1).unbind(0)
            values = values.where(share < start, line.drawn(part, low, high).to(values.dtype))
        return values

    def check(self, name: str, nominal: float) -> None:
        """Raise ConfigError if the range makes no sense for this parameter's nominal value."""
        for line in self.mixture or ():
            line.check(name, nominal)
        low, high = self.limits()
        if self.scales_nominal:
            if nominal == 0:
                raise ConfigError(
                    f"randomization of {name}: relative and factor bounds need a nominal value other than 0; "
                    "give absolute bounds"
                )
            low, high = sorted((low * nominal, high * nominal))
        for edge in (low, high):
            if not (bound := PARAMETERS[name].bound).holds(edge):
                raise ConfigError(f"randomization of {name} reaches {edge:g}; it must be {bound}")
        if self.distribution.positive and not self.limits()[0] > 0:
            raise ConfigError(f"randomization of {name}: {self.distribution} needs bounds above 0")


class IdentifiedSettings(Settings):
    """Identified carts, in place of ranges about the nominal cart."""

    posterior: Path  # posterior.npz of cartpole-identify, or carts as .csv: a column for each parameter
    widen: Positive = 1.0  # factor of its uncertainty
    prior_share: Fraction = 0.0  # of the carts, which are nominal ones within `ranges`
    ranges: dict[str, Range] = Field(default_factory=dict)  # of what is not identified, and the prior share


def check_carts(cart: Mapping[str, float], poles: PoleSettings, ranges: Mapping[str, Range]) -> None:
    """Raise ConfigError if such carts cannot be drawn.

    Causes: an unknown name, an impossible nominal value, a range that reaches an impossible value, a
    correlation with a parameter without a range, or a parameter of the pole in `cart`.
    """
    for name in Pole.model_fields:
        if name in cart:
            raise ConfigError(f"{name} belongs to the pole, not to the cart: choose another pole")
    nominal = completed({**cart, **poles.nominal.model_dump()})
    check_values(nominal)
    check_names(ranges)
    for name, line in ranges.items():
        for pole in possible_poles(poles):
            line.check(name, {**nominal, **pole.model_dump()}[name])
        for other in line.correlation:
            if other not in ranges or other == name:
                raise ConfigError(f"randomization of {name}: correlation takes other randomized parameters")
