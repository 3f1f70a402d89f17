"""Distributions between bounds, by name, each as the map of a uniform share to a value.

A share of a seeded generator decides each value, so draws repeat to the bit, and lines can be correlated by
their shares. Functions use methods of tensors, and import SciPy where they run, so that settings load
without PyTorch and SciPy.
"""

import math
from collections.abc import Callable, Mapping
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any

from pydantic import create_model

from cartpole_rl.checking import validated
from cartpole_rl.errors import ConfigError
from cartpole_rl.registry import Extension, Registry
from cartpole_rl.settings import Finite, Positive, Settings

if TYPE_CHECKING:
    from torch import Tensor

PLACES = ("mean", "median")  # keywords in the terms of the bounds, and within them
WIDTH = 4  # standard deviations between the bounds, where none is given


class Distribution(Extension):
    """A distribution between bounds.

    Its function takes shares [R, N] of 0 to 1 and bounds, low and high, [R, 1] float64, to values [R, N]
    within the bounds. Its keywords are settings, with types and defaults as in its signature. One with the
    keyword `values` has a list of values in place of bounds. Bounds of a `positive` one are above 0.
    """

    def __init__(self, name: str, item: Callable[..., "Tensor"], positive: bool = False) -> None:
        super().__init__(name, item)
        self.positive = positive
        keywords = {each.name: each for each in signature(item).parameters.values() if each.kind == KEYWORD}
        self.listed = keywords.pop("values", None) is not None
        for key, each in keywords.items():
            if each.annotation is Parameter.empty:
                raise ConfigError(f"{name}: give its keyword {key} a type, as in {key}: float")
        fields: Any = {
            key: (each.annotation, ... if each.default is Parameter.empty else each.default)
            for key, each in keywords.items()
        }
        self._shape = create_model("Shape", __base__=Settings, **fields)

    def shape(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the keywords of the function from settings. Raises ConfigError."""
        for name in given.keys() - self._shape.model_fields.keys():
            taken = ", ".join(("bounds", *self._shape.model_fields))
            raise ConfigError(f"{name}: there is no such setting; {self} takes {taken}")
        return validated(self._shape, given).model_dump()


KEYWORD = Parameter.KEYWORD_ONLY
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


@DISTRIBUTIONS.register("truncated_normal")
def truncated_normal(
    share: "Tensor", low: "Tensor", high: "Tensor", *, mean: Finite | None = None, std: Positive | None = None
) -> "Tensor":
    """Normal, cut off at the bounds; by default about their middle, with the bounds at two deviations."""
    middle = (low + high) / 2 if mean is None else mean
    spread = (high - low).clamp(min=1e-30) / WIDTH if std is None else std
    scale = math.sqrt(2) * spread
    first, last = ((low - middle) / scale).erf(), ((high - middle) / scale).erf()
    return (middle + scale * (first + share * (last - first)).erfinv()).clamp(low, high)


@DISTRIBUTIONS.register("log_normal", positive=True)
def log_normal(
    share: "Tensor",
    low: "Tensor",
    high: "Tensor",
    *,
    median: Finite | None = None,
    sigma: Positive | None = None,
) -> "Tensor":
    """Normal in the logarithm, cut off at the bounds; `sigma` is the standard deviation there."""
    mean = None if median is None else float(low.new_tensor(median).log())
    return truncated_normal(share, low.log(), high.log(), mean=mean, std=sigma).exp().clamp(low, high)


@DISTRIBUTIONS.register("beta")
def beta(
    share: "Tensor", low: "Tensor", high: "Tensor", *, alpha: Positive = 2.0, beta: Positive = 2.0
) -> "Tensor":
    """Beta distribution stretched over the bounds."""
    from scipy.special import betaincinv

    return low + (high - low) * low.new_tensor(betaincinv(alpha, beta, share.double().cpu().numpy()))


@DISTRIBUTIONS.register("discrete")
def discrete(
    share: "Tensor",
    low: "Tensor",
    high: "Tensor",
    *,
    values: tuple[float, ...],
    weights: tuple[Positive, ...] | None = None,
) -> "Tensor":
    """One of the values, each with a probability in proportion to its weight."""
    edges = low.new_tensor(weights or [1.0] * len(values)).cumsum(0)
    place = (share.unsqueeze(-1) * edges[-1] >= edges[:-1]).sum(-1)
    return low.new_tensor(values)[place]
