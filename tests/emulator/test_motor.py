"""The emulated motor: force curve, dead-band, asymmetry and lag."""

import math

import pytest

from cartpole_rl.emulator.physics import Motor
from cartpole_rl.emulator.settings import EmulatorSettings

PLAIN_MOTOR = {
    "force_curve": (0.0, 0.02, 0.0),
    "force_asymmetry": 0.0,
    "deadband_left": 0.0,
    "deadband_right": 0.0,
    "motor_time_constant": 0.0,
}


def test_force_curve_dead_band_and_asymmetry():
    settings = EmulatorSettings(
        force_curve=(1e-5, 0.02, -1.0), force_asymmetry=0.1, deadband_left=80, deadband_right=60
    )
    motor = Motor(settings)
    assert motor.static_force(100) == pytest.approx(1.1 * 1.1)
    assert motor.static_force(-100) == pytest.approx(-1.1)
    assert motor.static_force(60) == motor.static_force(-80) == motor.static_force(0) == 0.0
    assert motor.static_force(61) > 0 > motor.static_force(-81)
    assert Motor(EmulatorSettings(deadband_right=0)).static_force(30) == 0.0  # the curve is never negative


def test_force_lags_by_its_time_constant():
    motor = Motor(EmulatorSettings(**PLAIN_MOTOR | {"motor_time_constant": 0.01}))
    decay = motor.decay(0.01)
    assert motor.step(motor.static_force(100), decay) == pytest.approx(2.0 * (1 - math.exp(-1)))
    assert motor.step(motor.static_force(0), decay) == pytest.approx(2.0 * (1 - math.exp(-1)) * math.exp(-1))
    without_lag = Motor(EmulatorSettings(**PLAIN_MOTOR))
    assert without_lag.step(without_lag.static_force(100), without_lag.decay(0.001)) == pytest.approx(2.0)
