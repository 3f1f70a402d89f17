"""The picture of what a randomization draws."""

import numpy as np

from cartpole_rl.reporting.randomization import LONGEST_LINE, correlations


def test_correlated_pairs_fit_into_the_width_of_the_picture() -> None:
    drawn = np.random.default_rng(0).normal(size=100)
    names = ("cart_mass", "cart_viscous", "force_linear", "motor_time_constant")
    text = correlations(dict.fromkeys(names, drawn))
    assert "cart_viscous and force_linear 1.00" in " ".join(text.split())
    assert all(len(line) <= LONGEST_LINE for line in text.splitlines())
