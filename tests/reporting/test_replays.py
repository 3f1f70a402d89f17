"""Errors of a replay are statistics of the stretches that are long enough."""

import numpy as np
import pytest

from cartpole_rl.reporting.replays import ReplayedEpisode, errors_at, root_mean_square


def test_rms_is_of_what_is_known() -> None:
    errors = np.array([[3.0, 1.0, np.nan], [4.0, np.nan, np.nan]])
    np.testing.assert_allclose(root_mean_square(errors), [np.sqrt(12.5), 1.0, np.nan])


def test_errors_count_the_stretches_that_reach_a_time(replay: ReplayedEpisode) -> None:
    early, late = errors_at([replay, replay], (0.1, 1.0, 7.0), 0.02)  # none at 7 s
    assert (early["after_s"], early["stretches"]) == (0.1, 18)
    assert (late["after_s"], late["stretches"]) == (1.0, 16)
    for line in (early, late):
        assert line["rms_x_mm"] == pytest.approx(20)
        assert line["median_theta_deg"] == pytest.approx(3)
