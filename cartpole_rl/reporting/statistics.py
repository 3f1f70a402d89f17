"""Statistics of few seeds, after Agarwal et al. (2021), "Deep RL at the edge of the statistical precipice".

One number per agent (the mean over its evaluation episodes) enters; agents are what is resampled.

- Interquartile mean (IQM): the mean of the values without the floor(n / 4) lowest and highest ones, as in the
  authors' `rliable`. Up to three values it is their mean.
- Intervals: the 2.5 and 97.5 percentiles of RESAMPLES bootstrap samples. A sample draws, within each group,
  as many values as it has, with replacement ("stratified bootstrap").
- Performance profile: the share of agents above a score, for every score.
- Probability of improvement: the share of pairs (x, y) with x > y, ties counted half (Mann and
  Whitney, 1947).
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cartpole_rl.settings import CONFIDENCE

RESAMPLES = 5000
TRIMMED = 0.25  # share of the values cut off at each end
EDGES = (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE))  # percent
MOST_RESAMPLED = 2_000_000  # values that are drawn at once

Array = NDArray[np.float64]
Statistic = Callable[..., Array]  # of arrays [..., n], reduced over the last axis


class Estimate(NamedTuple):
    """A statistic, its 95 % interval (None for a single value) and the number of agents."""

    value: float
    low: float | None
    high: float | None
    agents: int


def bootstrap(statistic: Statistic, *groups: ArrayLike, agents: int | None = None) -> Estimate:
    """Return a statistic of independent groups [n_i], each resampled by itself.

    `agents` is the size of the smallest group if not given. The same groups give the same interval.
    """
    arrays = [np.asarray(each) for each in groups]
    count = min(each.size for each in arrays) if agents is None else agents
    value, generator = float(statistic(*arrays)), np.random.default_rng(0)
    if count < 2:
        return Estimate(value, None, None, count)
    chunks = -(-RESAMPLES * sum(each.size for each in arrays) // MOST_RESAMPLED)
    sizes = np.diff(np.linspace(0, RESAMPLES, chunks + 1, dtype=int))
    samples = np.concatenate(
        [
            statistic(*(each[generator.integers(each.size, size=(size, each.size))] for each in arrays))
            for size in sizes
        ]
    )
    low, high = np.nanpercentile(samples, EDGES)
    return Estimate(value, float(low), float(high), count)


def interquartile_mean(values: ArrayLike) -> Array:
    """Return the IQM over the last axis of `values` [..., n]."""
    ordered = np.sort(np.asarray(values, dtype=float), axis=-1)
    cut = int(TRIMMED * ordered.shape[-1])
    return np.asarray(ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1))


def estimate(*groups: ArrayLike) -> Estimate:
    """Return the IQM of all values of the groups [n_i], each resampled by itself.

    Raises ValueError if there is no value.
    """
    return _pooled(tuple(tuple(np.asarray(each, dtype=float).tolist()) for each in groups))


@lru_cache(maxsize=4096)  # a page shows the same agents in its text, its tables and its figures
def _pooled(groups: tuple[tuple[float, ...], ...]) -> Estimate:
    if not (count := sum(map(len, groups))):
        raise ValueError("an estimate needs at least one value")
    return bootstrap(lambda *parts: interquartile_mean(np.concatenate(parts, axis=-1)), *groups, agents=count)


def difference(values: ArrayLike, others: ArrayLike) -> Estimate:
    """Return IQM(values) - IQM(others) for independent agents."""
    return bootstrap(lambda a, b: interquartile_mean(a) - interquartile_mean(b), values, others)


def paired_difference(values: ArrayLike, others: ArrayLike) -> Estimate:
    """Return IQM(values - others) of the same agents [n] in both, whose pairs are resampled."""
    return estimate(np.subtract(values, others))


def probability_of_improvement(values: ArrayLike, others: ArrayLike) -> Estimate:
    """Return the probability that an agent of `values` [n] scores more than one of `others` [m]."""
    return bootstrap(_share_above, values, others)


def paired_improvement(values: ArrayLike, others: ArrayLike) -> Estimate:
    """Return the share of the same agents [n] that score more in `values`; ties count half."""
    signs = np.sign(np.subtract(values, others))
    return bootstrap(lambda sample: 0.5 + 0.5 * sample.mean(axis=-1), signs)


def _share_above(values: Array, others: Array) -> Array:
    """Return the share of pairs of `values` [..., n] and `others` [..., m] in which the first is higher.

    It is Mann and Whitney's U, from ranks, so that pairs need no memory.
    """
    from scipy import stats  # slow to import

    n, m = values.shape[-1], others.shape[-1]
    ranks = stats.rankdata(np.concatenate([values, others], axis=-1), axis=-1)
    pairs = ranks[..., :n].sum(axis=-1) - n * (n + 1) / 2
    return np.asarray(0.5 + 0.5 * ((2 * pairs - n * m) / (n * m)))


def performance_profile(values: ArrayLike, scores: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the share of `values` [n] above each of `scores` [S], and its pointwise 95 % interval.

    The interval is that of the bootstrap: a resampled share is binomial.
    """
    from scipy import stats  # slow to import

    ordered = np.sort(np.asarray(values, dtype=float))
    share = 1 - np.searchsorted(ordered, np.asarray(scores, dtype=float), side="right") / ordered.size
    low, high = (stats.binom.ppf(edge / 100, ordered.size, share) / ordered.size for edge in EDGES)
    return share, low, high
