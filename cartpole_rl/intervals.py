"""Intervals of a mean, and the confidence of every interval that is reported."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import stats

CONFIDENCE = 0.95


def student_interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the 95 % interval of the mean of `values` [M] by Student's t; NaN for a single value."""
    if values.size < 2:
        return math.nan, math.nan
    error = float(values.std(ddof=1)) / math.sqrt(values.size)
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, values.size - 1)) * error
    return float(values.mean()) - half, float(values.mean()) + half
