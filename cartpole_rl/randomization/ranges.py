"""Randomization as data: for each parameter one line with a distribution and its bounds.

Bounds are `absolute` (the value itself), `relative` (nominal * (1 + bound)) or `factor` (nominal * bound).
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import model_validator

from cartpole_rl.errors import ConfigError
from cartpole_rl.randomization.poles import Pole, PoleSettings, possible_poles
from cartpole_rl.registry import Extension, Registry
from cartpole_rl.rig.parameters import PARAMETERS, check_names, check_values, completed
from cartpole_rl.settings import Finite, Fraction, Positive, Settings

if TYPE_CHECKING:
    from torch import Tensor

Bounds = tuple[Finite, Finite]


class Distribution(Extension):
    """A distribution between bounds, by its quantiles.

    Its function takes shares [R, N] of 0 to 1 and bounds, low and high, [R, 1] float64, to values [R, N]; a
    share of 0 gives the low bound, 1 the high one. It uses methods of tensors alone, so that settings load
    without PyTorch. Bounds of a `positive` distribution are above 0.
    """

    def __init__(
        self, name: str, item: Callable[["Tensor", "Tensor", "Tensor"], "Tensor"], positive: bool = False
    ) -> None:
        super().__init__(name, item)
        self.positive = positive


DISTRIBUTIONS = Registry("distribution", __name__, Distribution, decorated=True)


@DISTRIBUTIONS.register("uniform")
def uniform(share: "Tensor", low: "Tensor", high: "Tensor") -> "Tensor":
    """Uniform between the bounds."""
    low = low.to(share.dtype)
    return low + share * (high.to(share.dtype) - low)


@DISTRIBUTIONS.register("log_uniform", positive=True)
def log_uniform(share: "Tensor", low: "Tensor", high: "Tensor") -> "Tensor":
    """Uniform in the logarithm."""
    return uniform(share, low.log(), high.log()).exp()


class Range(Settings):
    """Distribution and exactly one kind of bounds, [low, high]."""

    distribution: Annotated[Distribution, DISTRIBUTIONS] = DISTRIBUTIONS.find("uniform")
    absolute: Bounds | None = None
    relative: Bounds | None = None
    factor: Bounds | None = None

    @model_validator(mode="after")
    def _one_kind_in_order(self) -> "Range":
        given = [bounds for bounds in (self.absolute, self.relative, self.factor) if bounds is not None]
        if len(given) != 1:
            raise ValueError("give exactly one of absolute, relative, factor")
        if given[0][0] > given[0][1]:
            raise ValueError(f"bounds {list(given[0])} are in the wrong order")
        return self

    @property
    def scales_nominal(self) -> bool:
        """The drawn value is a multiple of the nominal one."""
        return self.absolute is None

    def limits(self) -> Bounds:
        """Return [low, high] of the value (absolute) or of its ratio to the nominal one."""
        if self.relative is not None:
            return 1 + self.relative[0], 1 + self.relative[1]
        bounds = self.absolute or self.factor
        assert bounds is not None
        return bounds

    def check(self, name: str, nominal: float) -> None:
        """Raise ConfigError if the range makes no sense for this parameter's nominal value."""
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

    posterior: Path  # posterior.npz of cartpole-identify
    widen: Positive  # factor of its uncertainty
    prior_share: Fraction  # of the carts, which are nominal ones within `ranges`
    ranges: dict[str, Range]  # of parameters that are not identified, and of the prior share


def check_carts(cart: Mapping[str, float], poles: PoleSettings, ranges: Mapping[str, Range]) -> None:
    """Raise ConfigError if such carts cannot be drawn.

    Causes: an unknown name, an impossible nominal value, a range that reaches an impossible value, or a
    parameter of the pole in `cart`.
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
