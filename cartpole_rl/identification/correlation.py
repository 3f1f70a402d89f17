"""Correlation of two samples, also of constant ones."""

import numpy as np
from numpy.typing import NDArray


def correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Return the correlation coefficient, 0 if one of the samples is constant."""
    varies = first.size > 1 and np.ptp(first) > 0 and np.ptp(second) > 0
    return float(np.corrcoef(first, second)[0, 1]) if varies else 0.0
