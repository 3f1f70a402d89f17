"""Comparison of exported action values with those of PyTorch."""

import numpy as np

from cartpole_rl.exporting.agent import Floats

TIE = 1e-3  # two action values, of a size of about 50, that are this close count as equal


def assert_same_actions(actions: np.ndarray, values: Floats) -> None:
    """Check that each action is the greedy one of `values` [M, A], or has the same value."""
    lost = values.max(1) - np.take_along_axis(values, actions[:, None].astype(int), 1)[:, 0]
    assert lost.max() < TIE
    assert (lost > 0).sum() <= 1 + 1e-4 * len(lost)  # such ties are rare
