"""Identified parameters are compared with the truth of the emulated cart."""

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


def test_the_true_numbers_have_no_error() -> None:
    assert set(errors(EXACT, TRUTH)["errors"].values()) == {0.0}


def test_an_error_is_relative_to_the_truth() -> None:
    found = errors({**EXACT, "cart_mass": 1.5 * TRUTH.cart_mass}, TRUTH)["errors"]
    assert round(found["cart_mass"], 9) == 0.5
    assert found["median"] == 0


def test_what_was_not_estimated_has_no_error() -> None:
    found = errors({**EXACT, "cart_viscous": 0.0, "cart_mass": 2 * TRUTH.cart_mass}, TRUTH, {"cart_viscous"})
    assert "cart_viscous" not in found["errors"]
    assert found["errors"]["cart_mass"] == 1


def test_without_a_truth_there_are_none() -> None:
    assert errors(EXACT, None) == {}
