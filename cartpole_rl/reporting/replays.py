"""Prediction errors of a simulated cart that is reset to a recorded one at regular intervals."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cartpole_rl.tasks.episode import Episode

Array = NDArray[np.float64]


class ReplayedEpisode(Protocol):
    """A recorded episode and its simulation in S stretches of T periods, as `identification.replay` makes it.

    `time`, `x` (m), `theta` (rad, not wrapped) and the errors are [S, T + 1]; NaN where a stretch ends early.
    """

    @property
    def episode(self) -> Episode: ...  # noqa: D102
    @property
    def time(self) -> Array: ...  # noqa: D102
    @property
    def x(self) -> Array: ...  # noqa: D102
    @property
    def theta(self) -> Array: ...  # noqa: D102
    @property
    def x_error(self) -> Array: ...  # noqa: D102
    @property
    def theta_error(self) -> Array: ...  # noqa: D102


def errors_at(
    replays: Sequence[ReplayedEpisode], times: Sequence[float], period: float
) -> list[dict[str, Any]]:
    """Return RMS and median of the absolute errors at those `times` (s after a reset) that are reached."""
    x, theta = stack_errors(replays)
    lines = []
    for time in times:
        index = round(time / period)
        if index >= x.shape[1] or not np.isfinite(x[:, index]).any():
            continue
        cart, pole = 1e3 * x[:, index : index + 1], np.degrees(theta[:, index : index + 1])
        lines.append(
            {
                "after_s": time,
                "stretches": int(np.isfinite(cart).sum()),
                "rms_x_mm": float(root_mean_square(cart)[0]),
                "median_x_mm": float(np.nanmedian(np.abs(cart))),
                "rms_theta_deg": float(root_mean_square(pole)[0]),
                "median_theta_deg": float(np.nanmedian(np.abs(pole))),
            }
        )
    return lines


def stack_errors(replays: Sequence[ReplayedEpisode]) -> tuple[Array, Array]:
    """Return the errors of all stretches in m and rad, [E, T + 1] each."""
    return (
        np.concatenate([replay.x_error for replay in replays]),
        np.concatenate([replay.theta_error for replay in replays]),
    )


def root_mean_square(errors: Array) -> Array:
    """Return the RMS [L] of the finite values in each column of `errors` [E, L]; NaN if there are none."""
    known = np.isfinite(errors)
    count = known.sum(0)
    total = np.where(known, errors, 0.0) ** 2
    return np.sqrt(np.where(count > 0, total.sum(0) / np.maximum(count, 1), np.nan))
