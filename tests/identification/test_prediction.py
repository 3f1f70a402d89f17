"""Errors of predictions are statistics of the windows that are long enough."""

import numpy as np
import pytest

from cartpole_rl.identification.prediction import errors_at, root_mean_square

REACHED = np.where(np.arange(51)[:, None, None] < [51] * 16 + [30] * 2, 1.0, np.nan)  # two of 18 end early
ERROR = REACHED * np.array([0.02, np.radians(3)])[:, None]  # [51, 2, 18] m, rad


def test_rms_is_of_what_is_known() -> None:
    errors = np.array([[3.0, 1.0, np.nan], [4.0, np.nan, np.nan]]).T
    np.testing.assert_allclose(root_mean_square(errors), [np.sqrt(12.5), 1.0, np.nan])


def test_errors_count_the_windows_that_reach_a_time() -> None:
    early, late = errors_at(ERROR, (0.1, 1.0, 7.0), 0.02)  # none at 7 s
    assert (early["after_s"], early["windows"]) == (0.1, 18)
    assert (late["after_s"], late["windows"]) == (1.0, 16)
    for line in (early, late):
        assert line["rms_x_mm"] == pytest.approx(20)
        assert line["median_theta_deg"] == pytest.approx(3)
        assert "rms_spread_x_mm" not in line


def test_spreads_stand_beside_the_errors() -> None:
    spread = np.full_like(ERROR, 0.015)
    spread[:, :, :9] = 0.005  # too small for the cart's error, within two for the rest
    (line,) = errors_at(ERROR, [0.1], 0.02, spread)
    assert line["within_x_mm"] == pytest.approx(0.5)
    assert line["median_spread_x_mm"] == pytest.approx(10)
    assert line["rms_spread_x_mm"] == pytest.approx(np.sqrt(125))
