"""One line of randomization: a distribution and its bounds, for one parameter.

Bounds are `absolute` (the value itself), `relative` (nominal * (1 + bound)) or `factor` (nominal * bound).
"""

import math
from enum import StrEnum

from pydantic import model_validator

from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.parameters import PARAMETERS
from cartpole_rl.settings import Finite, Settings

Bounds = tuple[Finite, Finite]


class Distribution(StrEnum):
    """Distribution of a value between its bounds."""

    UNIFORM = "uniform"
    LOG_UNIFORM = "log_uniform"


class Range(Settings):
    """Distribution and exactly one kind of bounds, [low, high]."""

    distribution: Distribution = Distribution.UNIFORM
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
        if self.absolute is not None:
            return self.absolute
        if self.factor is not None:
            return self.factor
        assert self.relative is not None
        return 1 + self.relative[0], 1 + self.relative[1]

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
        if self.distribution is Distribution.LOG_UNIFORM and not self.limits()[0] > 0:
            raise ConfigError(f"randomization of {name}: log_uniform needs bounds above 0")

    def warped(self) -> Bounds:
        """Return the limits on the axis on which the draw is uniform."""
        low, high = self.limits()
        if self.distribution is Distribution.LOG_UNIFORM:
            return math.log(low), math.log(high)
        return low, high
