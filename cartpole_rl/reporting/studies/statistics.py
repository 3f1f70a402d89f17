"""Statistics of few seeds, after Agarwal et al. (2021), "Deep RL at the edge of the statistical precipice".

One number per agent (the mean over its evaluation episodes) enters; agents are what is resampled.

- Interquartile mean (IQM): the mean of the values without the floor(n / 4) lowest and highest ones, as in the
  authors' `rliable`. Up to three values it is their mean.
- Intervals: the 2.5 and 97.5 percentiles of RESAMPLES bootstrap samples. A sample draws, within each stratum,
  as many values as it has, with replacement ("stratified bootstrap").
- Performance profile: the share of agents above a score, for every score.
- Probability of improvement: the share of pairs (x, y) with x > y, ties counted half (Mann and
  Whitney, 1947).
- Rank correlation: Spearman's rho, Pearson's correlation of the ranks, ties at their mean rank.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from cartpole_rl.intervals import CONFIDENCE

RESAMPLES = 5000
TRIMMED = 0.25  # share of the values cut off at each end
EDGES = (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE))  # percent
CHUNKS = 20  # of the samples of pairs, so that their ranks need little memory
FEWEST_RANKED = 4  # agents from which a rank correlation has an interval

Array = NDArray[np.float64]
Statistic = Callable[..., Array]  # of arrays [..., n], reduced over the last axis


class Estimate(NamedTuple):
    """A statistic, its 95 % interval (None for a single value) and the number of agents."""

    value: float
    low: float | None
    high: float | None
    agents: int


def interquartile_mean(values: ArrayLike) -> Array:
    """Return the IQM over the last axis of `values` [..., n]."""
    ordered = np.sort(np.asarray(values, dtype=float), axis=-1)
    cut = int(TRIMMED * ordered.shape[-1])
    return np.asarray(ordered[..., cut : ordered.shape[-1] - cut].mean(axis=-1))


def estimate(*strata: ArrayLike) -> Estimate:
    """Return the IQM of all values of the strata [n_i] with its stratified bootstrap interval.

    Raises ValueError if there is no value.
    """
    return _pooled_estimate(tuple(tuple(np.asarray(each, dtype=float).tolist()) for each in strata))


@lru_cache(maxsize=4096)  # a page shows the same agents in its text, its tables and its figures
def _pooled_estimate(strata: tuple[tuple[float, ...], ...]) -> Estimate:
    groups = [np.array(each) for each in strata]
    count = sum(each.size for each in groups)
    if not count:
        raise ValueError("an estimate needs at least one value")
    return _estimate(lambda *parts: interquartile_mean(np.concatenate(parts, axis=-1)), groups, count)


def mean_estimate(values: ArrayLike) -> Estimate:
    """Return the mean of `values` [n] with its bootstrap interval."""
    group = np.asarray(values, dtype=float)
    return _estimate(lambda sample: np.asarray(sample.mean(axis=-1)), [group], group.size)


def difference(values: ArrayLike, others: ArrayLike) -> Estimate:
    """Return IQM(values) - IQM(others) for independent agents; `agents` is that of the smaller group."""
    groups = [np.asarray(values, dtype=float), np.asarray(others, dtype=float)]
    return _estimate(
        lambda a, b: interquartile_mean(a) - interquartile_mean(b), groups, min(each.size for each in groups)
    )


def probability_of_improvement(values: ArrayLike, others: ArrayLike) -> Estimate:
    """Return the probability that an agent of `values` [n] scores more than one of `others` [m]."""
    groups = [np.asarray(values, dtype=float), np.asarray(others, dtype=float)]

    def share(*samples: Array) -> Array:
        if samples[0].ndim == 1:
            return _share_above(*samples)
        chunks = (np.array_split(each, CHUNKS) for each in samples)
        return np.concatenate([_share_above(*chunk) for chunk in zip(*chunks, strict=True)])

    return _estimate(share, groups, min(each.size for each in groups))


def _share_above(values: Array, others: Array) -> Array:
    """Return the share of pairs of `values` [..., n] and `others` [..., m] in which the first is higher.

    It is Mann and Whitney's U, from ranks, so that pairs need no memory.
    """
    n, m = values.shape[-1], others.shape[-1]
    ranks = stats.rankdata(np.concatenate([values, others], axis=-1), axis=-1)
    pairs = ranks[..., :n].sum(axis=-1) - n * (n + 1) / 2
    return np.asarray(0.5 + 0.5 * ((2 * pairs - n * m) / (n * m)))


def performance_profile(values: ArrayLike, scores: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the share of `values` [n] above each of `scores` [S], and its pointwise 95 % interval."""
    data, thresholds = np.asarray(values, dtype=float), np.asarray(scores, dtype=float)

    def above(sample: Array) -> Array:
        ordered = np.sort(sample, axis=-1)
        return np.stack([(ordered > threshold).mean(axis=-1) for threshold in thresholds], axis=-1)

    low, high = np.percentile(above(_resampled(data, _generator())), EDGES, axis=0)
    return above(data), low, high


def rank_correlation(values: ArrayLike, others: ArrayLike) -> Estimate | None:
    """Return Spearman's rho of the pairs of `values` [n] and `others` [n], agents resampled as pairs.

    None where it is undefined: fewer than two pairs, or no spread in one of them.
    """
    pairs = np.stack([np.asarray(values, dtype=float), np.asarray(others, dtype=float)])
    count = pairs.shape[1]
    rho = _spearman(pairs)
    if count < 2 or not np.isfinite(rho):
        return None
    if count < FEWEST_RANKED:
        return Estimate(float(rho), None, None, count)
    rows = _generator().integers(count, size=(RESAMPLES, count))
    samples = _spearman(np.moveaxis(pairs[:, rows], 0, -2))
    low, high = np.percentile(samples[np.isfinite(samples)], EDGES)
    return Estimate(float(rho), float(low), float(high), count)


def _spearman(pairs: Array) -> Array:
    """Return rho of `pairs` [..., 2, n]; NaN without spread."""
    ranks = stats.rankdata(pairs, axis=-1)
    ranks = ranks - ranks.mean(axis=-1, keepdims=True)
    covariance = (ranks[..., 0, :] * ranks[..., 1, :]).sum(-1)
    spread = np.sqrt(np.square(ranks).sum(-1).prod(-1))
    return np.divide(covariance, spread, out=np.full_like(spread, np.nan), where=spread > 0)


def _estimate(statistic: Statistic, groups: Sequence[Array], count: int) -> Estimate:
    """Return a statistic of independent `groups`, each resampled by itself."""
    value = float(statistic(*groups))
    if count < 2:
        return Estimate(value, None, None, count)
    generator = _generator()
    samples = statistic(*(_resampled(group, generator) for group in groups))
    low, high = np.percentile(samples, EDGES)
    return Estimate(value, float(low), float(high), count)


def _resampled(values: Array, generator: np.random.Generator) -> Array:
    """Return bootstrap samples [RESAMPLES, n] of `values` [n]."""
    return values[generator.integers(values.size, size=(RESAMPLES, values.size))]


def _generator() -> np.random.Generator:
    """Return the generator of one bootstrap: the same runs give the same page."""
    return np.random.default_rng(0)
