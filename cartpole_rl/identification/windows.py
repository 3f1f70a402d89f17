"""Cuts episodes into short windows, each with its own unknown initial state.

A prediction over a whole swing-up forgets its initial state: an error doubles every tenth of a second near
upright. Half a second is long enough for parameters to show and short enough for a search to converge.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.errors import RecordingError
from cartpole_rl.tasks.episode import Episode

HISTORY = 6  # periods of motor values before a window: longer than latency and lag together
IRREGULAR = 0.2  # share of the period that a frame may come early or late


class Windows(NamedTuple):
    """W windows of T periods."""

    positions: NDArray[np.float64]  # [T + 1, 2, W] encoder counts of cart and pole, as measured
    motors: NDArray[np.float64]  # [HISTORY + T, W] motor values chosen, oldest first
    episode: NDArray[np.int64]  # [W] number of the episode of each

    @property
    def periods(self) -> int:
        """T."""
        return len(self.positions) - 1

    @property
    def number(self) -> int:
        """W."""
        return self.positions.shape[2]


def cut_windows(episodes: Sequence[Episode], period: float, periods: int = 25, most: int = 240) -> Windows:
    """Cut windows of `periods` periods of `period` s, one after another, evenly thinned to at most `most`.

    A window over a lost or late frame is left out. Raises RecordingError where nothing is left, or where the
    recordings are of another rate.
    """
    counts, motors, origins = [], [], []
    for number, episode in enumerate(episodes):
        gaps = np.diff(episode.time)
        if len(gaps) and abs(np.median(gaps) / period - 1) > IRREGULAR:
            raise RecordingError(
                f"a recording has a frame every {np.median(gaps) * 1e3:.1f} ms, and not every "
                f"{period * 1e3:.1f} ms"
            )
        regular = np.abs(gaps / period - 1) < IRREGULAR
        padded = np.concatenate((np.zeros(HISTORY), episode.motor))
        for first in range(0, episode.measured_steps - periods + 1, periods):
            if regular[max(0, first - HISTORY) : first + periods].all():
                counts.append(episode.counts[first : first + periods + 1])
                motors.append(padded[first : first + HISTORY + periods])
                origins.append(number)
    if not counts:
        raise RecordingError(
            f"no recording holds {periods * period:g} s without a lost frame: record longer, check the cable"
        )
    chosen = np.unique(np.linspace(0, len(counts) - 1, min(most, len(counts))).round().astype(int))
    return Windows(
        np.stack([counts[index] for index in chosen], -1).astype(np.float64),
        np.stack([motors[index] for index in chosen], -1).astype(np.float64),
        np.array([origins[index] for index in chosen]),
    )
