"""Curves of an identified cart are those of the physics, for it, its posterior and its prior."""

import numpy as np
import pytest

from cartpole_rl.physics.actuator import ACTUATORS
from cartpole_rl.physics.friction import CART_FRICTIONS
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.reporting.curves import force_curve, friction_curve

NAMES = CartParameters.names()


@pytest.fixture(scope="module")
def prior(ip02: dict[str, float], medium: PoleSettings) -> dict[str, float]:
    return {**ip02, **medium.nominal.model_dump(), "cart_coulomb_asymmetry": 0.0}


def samples(prior: dict[str, float], **changes: tuple[float, ...]) -> np.ndarray:
    """Carts [P, N] that differ in `changes` alone."""
    count = len(next(iter(changes.values())))
    return np.array([changes.get(name, (prior[name],) * count) for name in NAMES])


def test_friction_over_velocity(prior: dict[str, float]) -> None:
    identified = {**prior, "cart_coulomb": 0.4, "cart_viscous": 2.0}
    carts = samples(prior, cart_viscous=(1.0, 3.0))
    curve = friction_curve(identified, carts, prior, CART_FRICTIONS.find("step"))
    fast = int(np.abs(curve.at - 0.5).argmin())
    assert curve.identified[fast] == pytest.approx(0.4 + 2.0 * 0.5)
    assert curve.identified[-1] == pytest.approx(-curve.identified[0])
    assert np.diff(curve.samples[fast]) == pytest.approx(2.0 * 0.5)
    assert curve.prior[fast] == pytest.approx(prior["cart_coulomb"] + prior["cart_viscous"] * 0.5)


@pytest.mark.parametrize("sign", [-1, 1])
def test_force_over_motor_value(prior: dict[str, float], sign: int) -> None:
    symmetric = {**prior, "force_asymmetry": 0.0}
    identified = {**symmetric, "force_linear": 0.03}
    curve = force_curve(
        identified, samples(symmetric, force_linear=(0.03,)), symmetric, ACTUATORS.find("force_curve")
    )
    (at,) = np.flatnonzero(curve.at == sign * 200)
    assert curve.identified[at] - curve.prior[at] == pytest.approx(
        sign * 200 * (0.03 - prior["force_linear"])
    )
    assert curve.samples[at, 0] == pytest.approx(curve.identified[at])
