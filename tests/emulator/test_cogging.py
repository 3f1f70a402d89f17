"""The force ripple along the emulated cart's track: its size, its pitch, and that it takes no energy."""

import math

import pytest

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from cartpole_rl.emulator.physics import CartPhysics
from cartpole_rl.emulator.settings import EmulatorSettings

MASS = 0.8
BARE = {
    "cart_mass": MASS,
    "pole_mass": 1e-6,
    "pole_com": 0.01,
    "pole_inertia": 1e-10,
    "cart_viscous": 0.0,
    "cart_coulomb_left": 0.0,
    "cart_coulomb_right": 0.0,
    "track_tilt": 0.0,
}


def cart(amplitude: float, pitch: float = 0.04, **changes: float) -> CartPhysics:
    return CartPhysics(EmulatorSettings(**BARE | changes, cogging=amplitude, cogging_pitch=pitch))


def test_there_is_none_by_default() -> None:
    plain = CartPhysics(EmulatorSettings(**BARE))
    plain.place(0.01, math.pi)
    plain.advance(0, 0.5)
    assert plain.x == 0.01


@pytest.mark.parametrize("pitch", [0.04, 0.01])
def test_a_cart_swings_about_its_resting_place(pitch: float) -> None:
    """With the period of a small oscillation, 2 pi sqrt(m p / (2 pi A))."""
    swinging, amplitude = cart(0.3, pitch), 0.3
    swinging.place(0.01 * pitch + 5 * pitch, math.pi)
    half = math.pi * math.sqrt(MASS * pitch / (math.tau * amplitude))
    swinging.advance(0, half)
    assert swinging.x - 5 * pitch == pytest.approx(-0.01 * pitch, rel=0.03)


def test_it_gives_back_the_energy_that_it_takes() -> None:
    """A cart is slowest on top of a tooth, by the work of half a ripple, and equally fast in each valley."""
    coasting, amplitude, pitch = cart(0.4), 0.4, 0.04
    coasting.place(-0.3, math.pi)
    coasting.advance(200, 0.12)
    coasting.advance(0, 0.1)  # twenty times the motor's lag
    start, speeds = coasting.x, []
    while coasting.x < start + 2 * pitch:
        coasting.advance(0, 5e-4)
        speeds.append((coasting.x - start, coasting.x_dot))
    fastest, again = (
        max(speed for x, speed in speeds if first <= x < first + pitch) for first in (0.0, pitch)
    )
    slowest = min(speed for _, speed in speeds)
    assert slowest == pytest.approx(
        math.sqrt(fastest**2 - 2 * (amplitude * pitch / math.pi) / MASS), rel=0.002
    )
    assert again == pytest.approx(fastest, rel=0.002)


def test_it_adds_to_what_friction_holds() -> None:
    """Up to a motor force of Coulomb friction and amplitude together a cart at rest does not come free."""
    coulomb, amplitude = 0.5, 0.4
    motor = {
        "force_curve": (0.0, 0.01, 0.0),
        "force_asymmetry": 0.0,
        "deadband_left": 0.0,
        "deadband_right": 0.0,
        "cart_coulomb_left": coulomb,
        "cart_coulomb_right": coulomb,
        "cart_stiction_ratio": 1.0,
    }
    for value, comes_free in {85: False, 130: True}.items():
        pushed = cart(amplitude, **motor)
        pushed.place(0.0, math.pi)
        for step in range(value + 1):  # slowly, so that it is never thrown over a tooth
            pushed.advance(step, 0.02)
        pushed.advance(value, 1.0)
        assert (pushed.x > 0.04) == comes_free
