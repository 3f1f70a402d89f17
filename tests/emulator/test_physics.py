"""The emulated cart's physics against closed forms: energy, periods, friction, stops, tilt, motor."""

import math

import pytest

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

import itertools

from cartpole_rl.emulator.physics import GRAVITY, CartPhysics, Motor
from cartpole_rl.emulator.settings import EmulatorSettings

FREE = {
    "cart_viscous": 0.0,
    "cart_coulomb_left": 0.0,
    "cart_coulomb_right": 0.0,
    "pole_viscous": 0.0,
    "pole_coulomb": 0.0,
    "pole_drag": 0.0,
    "track_tilt": 0.0,
}
PLAIN_MOTOR = {
    "force_curve": (0.0, 0.02, 0.0),
    "force_asymmetry": 0.0,
    "deadband_left": 0.0,
    "deadband_right": 0.0,
    "motor_time_constant": 0.0,
}
MEDIUM = {"pole_mass": 0.127, "pole_com": 0.1778, "pole_inertia": 1.199e-3}
NO_POLE = {"pole_mass": 1e-6, "pole_com": 0.01, "pole_inertia": 1e-10}
HELD = {"cart_mass": 1e4}
PERIOD = 0.02


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


def energy(cart: CartPhysics, settings: EmulatorSettings) -> float:
    """Kinetic and potential energy, J."""
    mass, arm = settings.pole_mass, settings.pole_com
    pivot_inertia = settings.pole_inertia + mass * arm**2
    kinetic = 0.5 * (settings.cart_mass + mass) * cart.x_dot**2 + 0.5 * pivot_inertia * cart.angle_dot**2
    coupling = mass * arm * cart.x_dot * cart.angle_dot * math.cos(cart.angle)
    return kinetic + coupling + mass * GRAVITY * arm * math.cos(cart.angle)


def swing(settings: EmulatorSettings, amplitude: float, seconds: float) -> tuple[list[float], list[float]]:
    """Times at which a pole let go at `amplitude` passes the bottom to the right, and its extremes, rad."""
    cart, step = CartPhysics(settings), 5e-4
    cart.place(0.0, math.pi + amplitude)
    passes, extremes, before, speed_before, side = [], [amplitude], amplitude, 0.0, 1
    for number in range(1, round(seconds / step) + 1):
        cart.advance(0, step)
        off, speed = cart.angle - math.pi, cart.angle_dot
        if before < 0 <= off:
            passes.append(step * (number - off / (off - before)))
        if speed * speed_before < 0 and off * side < 0:  # it turned, on the other side than last time
            extremes.append(abs(off))
            side = -side
        before, speed_before = off, speed
    return passes, extremes


def test_without_friction_energy_is_kept():
    settings = EmulatorSettings(**FREE, track_half_length=5.0)
    cart = CartPhysics(settings)
    cart.place(0.0, 2.0)
    start = energy(cart, settings)
    swing_height = settings.pole_mass * GRAVITY * settings.pole_com
    for _ in range(500):
        cart.advance(0, PERIOD)
        assert energy(cart, settings) == pytest.approx(start, abs=0.01 * swing_height)


def test_medium_pole_hangs_with_the_period_of_the_data_sheet():
    passes, _ = swing(EmulatorSettings(**FREE | MEDIUM | HELD), 0.02, 4.0)
    assert passes[1] - passes[0] == pytest.approx(0.964, abs=5e-4)


def test_upright_pole_falls_with_its_time_constant():
    settings = EmulatorSettings(**FREE | MEDIUM | HELD)
    cart = CartPhysics(settings)
    cart.place(0.0, 1e-4)
    cart.advance(0, 0.3)
    assert cart.angle == pytest.approx(1e-4 * math.cosh(0.3 / 0.1534), rel=0.01)


def test_viscous_bearing_makes_the_swing_decay_exponentially():
    settings = EmulatorSettings(**FREE | HELD | {"pole_viscous": 1e-3})
    _, extremes = swing(settings, 0.1, 10.0)
    inertia = settings.pole_inertia + settings.pole_mass * settings.pole_com**2
    half_period = math.pi / math.sqrt(settings.pole_mass * GRAVITY * settings.pole_com / inertia)
    expected = 0.1 * math.exp(-1e-3 / (2 * inertia) * half_period * (len(extremes) - 1))
    assert extremes[-1] == pytest.approx(expected, rel=0.01)


def test_dry_bearing_takes_the_same_from_every_swing_and_then_holds():
    settings = EmulatorSettings(**FREE | HELD | {"pole_coulomb": 5e-4})
    _, extremes = swing(settings, 0.1, 5.0)
    held = 5e-4 / (settings.pole_mass * GRAVITY * settings.pole_com)
    for before, after in itertools.pairwise(extremes):
        assert before - after == pytest.approx(2 * held, rel=0.03)
    cart = CartPhysics(settings)
    cart.place(0.0, math.pi + 0.9 * held)
    cart.advance(0, 10.0)
    assert cart.angle - math.pi == pytest.approx(0.9 * held, rel=0.01)


def test_drag_takes_more_from_large_swings():
    _, extremes = swing(EmulatorSettings(**FREE | HELD | {"pole_drag": 1e-4}), 1.0, 8.0)
    losses = [1 - after / before for before, after in itertools.pairwise(extremes)]
    assert losses[0] > 1.3 * losses[-1] > 0


@pytest.mark.parametrize(("direction", "coulomb"), [(1, 0.5), (-1, 0.7)])
def test_cart_coasts_down_under_viscous_and_dry_friction(direction, coulomb):
    friction = {"cart_viscous": 0.8, "cart_coulomb_left": 0.7, "cart_coulomb_right": 0.5}
    settings = EmulatorSettings(**FREE | PLAIN_MOTOR | NO_POLE | friction, track_half_length=2.0)
    cart = CartPhysics(settings)
    cart.advance(direction * 200, 0.2)
    speed = abs(cart.x_dot)
    for seconds in (0.05, 0.1, 0.15):
        cart.advance(0, 0.05)
        decay = math.exp(-0.8 * seconds / settings.cart_mass)
        assert abs(cart.x_dot) == pytest.approx(speed * decay - coulomb / 0.8 * (1 - decay), abs=2e-3)
    cart.advance(0, 2.0)
    stands = cart.x
    cart.advance(0, 2.0)
    assert cart.x == pytest.approx(stands, abs=1e-6)


@pytest.mark.parametrize("direction", [1, -1])
def test_cart_breaks_away_above_stiction_and_slides_on_below_it(direction):
    friction = {"cart_coulomb_left": 0.5, "cart_coulomb_right": 0.5, "cart_stiction_ratio": 1.3}
    cart = CartPhysics(EmulatorSettings(**FREE | PLAIN_MOTOR | NO_POLE | friction, track_half_length=5.0))
    cart.advance(direction * 32, 1.0)  # 0.64 N against 0.65 N
    assert abs(cart.x) < 1e-5
    cart.advance(direction * 34, 0.5)  # 0.68 N
    speed = abs(cart.x_dot)
    assert speed > 0.05
    cart.advance(direction * 27, 0.5)  # 0.54 N: less than breakaway, more than sliding friction
    assert abs(cart.x_dot) > speed


@pytest.mark.parametrize("direction", [1, -1])
def test_stops_hold(direction):
    settings = EmulatorSettings()
    cart = CartPhysics(settings)
    farthest = 0.0
    for _ in range(1000):
        cart.advance(direction * 255, 0.002)
        farthest = max(farthest, abs(cart.x))
    assert farthest < settings.track_half_length + 0.003
    assert abs(cart.x) == pytest.approx(settings.track_half_length, abs=1e-4)


def test_tilt_pulls_the_cart_to_the_lower_end_and_the_pole_hangs_by_gravity():
    cart = CartPhysics(EmulatorSettings(**FREE | NO_POLE | {"track_tilt": 0.01}))
    cart.advance(0, 0.5)
    assert cart.x_dot == pytest.approx(GRAVITY * math.sin(0.01) * 0.5, rel=1e-3)
    hanging = CartPhysics(EmulatorSettings(**FREE | HELD | {"track_tilt": 0.01, "cart_coulomb_right": 1e6}))
    hanging.advance(0, 5.0)
    assert hanging.angle == pytest.approx(math.pi, abs=1e-6)


def test_a_stepper_moves_as_it_is_told_whatever_pole_and_tilt_do():
    moved = {"backdrivability": 0, "cart_mass": 2, "track_tilt": 0.1, "pole_mass": 0.5}
    cart = CartPhysics(EmulatorSettings(**FREE | PLAIN_MOTOR | moved))
    cart.place(0.0, 2.0, 3.0)
    cart.advance(0, 0.5)
    assert abs(cart.x) < 1e-5
    cart.advance(100, 0.5)
    assert cart.x_dot == pytest.approx(0.5 * 1.0, rel=1e-3)  # 2 N on 2 kg
    assert cart.x == pytest.approx(0.5 * 1.0 * 0.5**2, rel=5e-3)


def test_a_finer_step_changes_little():
    ends = []
    for step in (1e-3, 2.5e-4):
        cart = CartPhysics(EmulatorSettings(physics_step=step))
        for motor in (200, -200, 150, -250, 0) * 4:
            cart.advance(motor, 0.1)
        ends.append((cart.x, cart.angle))
    assert ends[0] == pytest.approx(ends[1], abs=0.01)


@pytest.mark.parametrize(("motor", "share"), [(0, 0.4), (-51, 0.52), (255, 1.0)])
def test_a_coasting_motor_brakes_less_the_less_it_is_on(motor: int, share: float) -> None:
    """The speed approaches force over friction with the time constant mass over friction."""
    cart = CartPhysics(EmulatorSettings(**BARE | PLAIN_MOTOR | {"cart_viscous": 2.0, "coasting": 0.6}))
    end = 0.02 * motor / (2.0 * share)  # m/s
    cart.place(0.0, math.pi)
    cart.advance(200, 0.05)
    before = cart.x_dot
    cart.advance(motor, 0.03)
    left = math.exp(-0.03 * 2.0 * share / BARE["cart_mass"])
    assert cart.x_dot == pytest.approx(end + (before - end) * left, rel=1e-3)


# cogging: a force ripple along the track

BARE = FREE | NO_POLE | {"cart_mass": 0.8}


def rippled_cart(amplitude: float, pitch: float = 0.04, **changes: float) -> CartPhysics:
    return CartPhysics(EmulatorSettings(**BARE | changes, cogging=amplitude, cogging_pitch=pitch))


@pytest.mark.parametrize("pitch", [0.04, 0.01])
def test_a_cart_swings_about_a_cogging_position(pitch: float) -> None:
    """The period of a small oscillation is 2 pi sqrt(m p / (2 pi A))."""
    swinging, amplitude = rippled_cart(0.3, pitch), 0.3
    swinging.place(0.01 * pitch + 5 * pitch, math.pi)
    half = math.pi * math.sqrt(BARE["cart_mass"] * pitch / (math.tau * amplitude))
    swinging.advance(0, half)
    assert swinging.x - 5 * pitch == pytest.approx(-0.01 * pitch, rel=0.03)


def test_cogging_returns_the_energy_that_it_takes() -> None:
    """A cart is slowest on top of a tooth, by the work of half a ripple, and equally fast in each valley."""
    coasting, amplitude, pitch = rippled_cart(0.4), 0.4, 0.04
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
        math.sqrt(fastest**2 - 2 * (amplitude * pitch / math.pi) / BARE["cart_mass"]), rel=0.002
    )
    assert again == pytest.approx(fastest, rel=0.002)
