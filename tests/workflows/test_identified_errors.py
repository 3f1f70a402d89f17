"""Identified parameters are compared with the truth of the emulated cart."""

import pytest

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.workflows.identify import errors

TRUTH = EmulatorSettings(
    cart_coulomb_left=0.4, cart_coulomb_right=0.6, force_curve=(0.0, 0.02, -1.0), force_asymmetry=0.0
)
EXACT = {
    **{name: getattr(TRUTH, name) for name in ("cart_mass", "pole_mass", "pole_com", "cart_viscous")},
    "pole_viscous": TRUTH.pole_viscous,
    "cart_coulomb": 0.5,
    "force_quadratic": 0.0,
    "force_linear": 0.02,
    "force_offset": -1.0,
    "force_asymmetry": 0.0,
}


def test_an_error_is_relative_to_the_truth_of_what_was_estimated() -> None:
    assert set(errors(EXACT, TRUTH)["errors"].values()) == {0.0}
    found = errors(
        {**EXACT, "cart_viscous": 0.0, "cart_mass": 1.5 * TRUTH.cart_mass}, TRUTH, {"cart_viscous"}
    )
    assert "cart_viscous" not in found["errors"]
    assert found["errors"]["cart_mass"] == pytest.approx(0.5)
    assert found["errors"]["median"] == 0
    assert errors(EXACT, None) == {}
