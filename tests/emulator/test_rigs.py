"""Carts with other encoders, tracks, masses and motors: both firmwares home them and count alike."""

import itertools
import math
import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from driven_cart import COARSE, Driven
from firmwares import needs_compiler

from cartpole_rl.choices import choice
from cartpole_rl.composition import compose
from cartpole_rl.emulator.guards import FrozenCartWatch, FrozenPoleWatch
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.rig.hardware import Hardware, hardware_of, nominal_hardware
from cartpole_rl.wire.messages import Fault, Flags, SetMotor, SetPeriod, Start, State

pytestmark = needs_compiler
DEFAULT = EmulatorSettings()


@st.composite
def rigs(draw: st.DrawFn, spans: tuple[float, float] = (0.25, 2.0)) -> Hardware:
    """Return the rig of a cart whose motor can move it gently."""
    span, mass = draw(st.floats(*spans)), draw(st.floats(0.3, 3.0))
    friction = mass * draw(st.floats(0.2, 1.2))
    gentle_force = 2 * friction + mass * draw(st.floats(1.0, 3.0))
    offset, gentle_motor = draw(st.floats(0, 100)), draw(st.floats(160, 250))
    switches = draw(st.integers(0, 1))
    return Hardware(
        cart_nanometres_per_count=draw(st.integers(5_000, 120_000)),
        pole_counts_per_turn=draw(st.integers(600, 20_000)),
        track_span=span,
        soft_limit=min(0.027, span / 8),
        hard_limit=min(0.008, span / 20),
        braking=draw(st.floats(0.5, 10)),
        hard_push=draw(st.integers(150, 250)),
        moving_mass=mass,
        moving_friction=friction,
        motor_offset=offset,
        motor_per_newton=(gentle_motor - offset) / gentle_force,
        gentle_force=gentle_force,
        left_switch=switches,
        right_switch=switches,
    )


def cart_of(rig: Hardware, **numbers: Any) -> EmulatorSettings:
    """Return an emulated cart of a rig, which is a little different from the rig's rough numbers."""
    pole = 0.15 * rig.moving_mass
    weight = pole / DEFAULT.pole_mass
    return EmulatorSettings(
        cart_mass=1.05 * (rig.moving_mass - pole),
        pole_mass=pole,
        pole_inertia=weight * DEFAULT.pole_inertia,
        pole_viscous=weight * DEFAULT.pole_viscous,
        pole_coulomb=weight * DEFAULT.pole_coulomb,
        cart_viscous=0.6 * rig.moving_mass,
        cart_coulomb_left=1.1 * rig.moving_friction,
        cart_coulomb_right=1.0 * rig.moving_friction,
        force_curve=(0.0, 1 / rig.motor_per_newton, -rig.motor_offset / rig.motor_per_newton),
        deadband_left=rig.motor_offset,
        deadband_right=rig.motor_offset,
        **COARSE,
        **numbers,
    ).of_cart(rig.model_dump())


def home(cart: EmulatorSettings, firmware: str) -> tuple[Driven, State]:
    driven = Driven(**cart.model_dump() | {"firmware": firmware})
    return driven, driven.home()


def check_homes(cart: EmulatorSettings) -> None:
    """Check that both firmwares home a cart in the same way, and that its zeros are right."""
    rig = cart.hardware or nominal_hardware()
    (python, state), (c, same) = (home(cart, firmware) for firmware in ("python", "c"))
    assert (python.flags, state.fault) == (Flags.HOMED | rig.switches * Flags.LEFT_SWITCH, Fault.NONE)
    assert (same, c.info(), c.flags) == (state, python.info(), python.flags)
    info, (x, angle) = python.info(), python.measured(state)
    assert info.cart_nanometres_per_count == rig.cart_nanometres_per_count
    assert info.pole_counts_per_turn == rig.pole_counts_per_turn
    metres, radians = rig.encoders.metres, rig.encoders.radians
    half = cart.track_half_length
    near = max(3 * metres, 3e-4 if rig.switches else 0.0)  # m; a switch is seen up to 2 ms later
    found = [info.soft_limit_counts * metres, info.hard_limit_counts * metres]
    assert found == pytest.approx([half - rig.soft_limit, half - rig.hard_limit], abs=near)
    assert x == pytest.approx(python.x, abs=near)
    assert abs(python.x) < 2e-3
    off = math.remainder(angle - python.angle - cart.angle_offset, math.tau)
    assert abs(off) < max(3 * radians, math.radians(0.3))
    assert abs(math.remainder(angle - math.pi, math.tau)) < 0.07


@settings(max_examples=6, derandomize=True)
@given(rig=rigs(), seed=st.integers(0, 99))
def test_both_firmwares_home_the_cart_of_any_rig(rig: Hardware, seed: int) -> None:
    check_homes(cart_of(rig, seed=seed))


@settings(max_examples=3, derandomize=True)
@given(rig=rigs(spans=(0.2, 0.4)), seed=st.integers(0, 99))
def test_a_short_track_has_room_for_a_swinging_pole(rig: Hardware, seed: int) -> None:
    check_homes(cart_of(rig, seed=seed, boot="anywhere"))


def test_a_cart_like_ip02_on_half_its_track_homes() -> None:
    rig = hardware_of({"track_span": 0.396})
    cart = EmulatorSettings(**COARSE).of_cart(rig.model_dump())
    assert cart.track_half_length == 0.2
    check_homes(cart)
    fault = Fault.HOMING  # the span is wrong
    assert home(cart.model_copy(update={"hardware": None}), "python")[1].fault == fault


@pytest.mark.nightly
def test_the_longest_track_is_searched_to_its_end() -> None:
    check_homes(EmulatorSettings(**COARSE).of_cart({"track_span": 6.0}))


@pytest.mark.parametrize(
    ("period_us", "seed", "firmware"), [(5_000, 0, "python"), (20_000, 1, "c"), (100_000, 2, "python")]
)
def test_the_coarsest_encoders_are_fine_enough(period_us: int, seed: int, firmware: str) -> None:
    rig = hardware_of({"cart_nanometres_per_count": 600_000, "pole_counts_per_turn": 200})
    light = {"pole_viscous": 3e-4, "pole_coulomb": 1e-4}  # a bearing that leaves the braking to the cart
    cart = EmulatorSettings(**COARSE, **light, seed=seed, boot="anywhere").of_cart(rig.model_dump())
    driven = Driven(**cart.model_dump() | {"firmware": firmware})
    driven.ask(SetPeriod(period_us))
    state = driven.home()
    assert (driven.flags, state.fault) == (Flags.HOMED, Fault.NONE)
    assert state.time_us < 50e6
    if period_us > 20_000:
        return
    dice, faults = random.Random(seed), Fault.NONE
    driven.ask(Start())
    for push in range(400):  # short ones, one way and then the other
        motor = dice.choice([200, 255]) * (1 if push % 2 else -1)
        if abs(driven.x) > 0.1:
            motor = int(math.copysign(motor, -driven.x))
        for _ in range(dice.randint(1, 4)):
            faults |= Fault(driven.ask(SetMotor(motor)).fault)
    assert not faults & (Fault.CART_ENCODER | Fault.POLE_ENCODER)


@pytest.mark.parametrize("nanometres", [300_000, 1_000_000])
def test_a_slow_cart_with_coarse_counts_is_no_dead_encoder(nanometres: int) -> None:
    """Hard pushes of 0.9 m/s^2 to and fro, about as long as keep the cart within three counts."""
    rig = hardware_of(
        {"cart_nanometres_per_count": nanometres, "motor_per_newton": 111.0, "gentle_force": 1.5}
    )
    driven, dice, faults = Driven(**cart_of(rig).model_dump() | {"firmware": "c"}), random.Random(1), set()
    driven.cart.firmware.homed = True
    driven.ask(SetPeriod(5_000))
    driven.ask(Start())
    longest = 3 * math.sqrt(3e-9 * nanometres)
    for push in range(200):
        motor = int(math.copysign(200, -driven.x)) if abs(driven.x) > 0.1 else 200 - 400 * (push % 2)
        for _ in range(round(dice.uniform(0.3, 1.0) * longest / 0.005)):
            faults.add(driven.ask(SetMotor(motor)).fault)
    assert faults == {Fault.NONE}


def test_short_pushes_within_a_coarse_count_are_no_frozen_cart() -> None:
    coarse = FrozenCartWatch(hardware_of({"cart_nanometres_per_count": 500_000}))
    motors = [200, 200, -200, -200] * 100  # 10 ms each way: 0.25 mm at 5 m/s^2
    assert not any(coarse.frozen(7, motor, 5_000) for motor in motors)
    motors = [200] * 40 + [-200] * 40
    assert [coarse.frozen(7, motor, 5_000) for motor in motors].index(True) == 40 + 35


def test_a_coarse_pole_count_need_not_change_in_a_short_jerk() -> None:
    coarse = FrozenPoleWatch(hardware_of({"pole_counts_per_turn": 360}))
    jerks = itertools.accumulate([0, 0, 60, 0, -60] * 40)  # counts: 0.27 m/s for 5 ms
    assert not any(coarse.frozen(5, cart, 5_000) for cart in jerks)
    swings = itertools.accumulate(round(200 * math.sin(each / 20)) for each in range(1000))
    assert any(coarse.frozen(5, cart, 5_000) for cart in swings)


def test_a_rig_survives_json_and_leaves_a_chosen_track() -> None:
    rig = hardware_of({"track_span": 0.396})
    cart = EmulatorSettings(track_half_length=0.21).of_cart(rig.model_dump())
    assert cart.track_half_length == 0.21
    assert EmulatorSettings.model_validate_json(cart.model_dump_json()) == cart
    assert EmulatorSettings().of_cart({}).track_half_length == DEFAULT.track_half_length


def test_delays_tilt_deadband_and_dry_friction_of_the_file_are_emulated() -> None:
    """On top of the default cart's own, whose latency is 2 ms below that of ip02."""
    file = {
        "track_span": 0.5,
        "latency": 0.015,
        "latency_jitter": 0.002,
        "motor_time_constant": 0.02,
        "track_tilt": -0.01,
        "angle_offset": 0.03,
        "force_asymmetry": -0.1,
        "deadband_left": 70.0,
        "cart_stiction_ratio": 1.5,
        "cart_coulomb_asymmetry": 0.2,
        "pole_coulomb": 1e-4,
    }
    cart = EmulatorSettings().of_cart(file)
    assert (cart.latency, cart.latency_jitter) == pytest.approx((0.013, 0.003))
    assert (cart.motor_time_constant, cart.track_tilt) == pytest.approx((0.025, -0.008))
    assert (cart.angle_offset, cart.force_asymmetry) == pytest.approx((0.034, -0.07))
    assert (cart.deadband_left, cart.deadband_right, cart.cart_stiction_ratio) == (70.0, 60.0, 1.5)
    assert (cart.cart_coulomb_left, cart.cart_coulomb_right) == pytest.approx((0.8 * 0.58, 1.2 * 0.53))
    assert cart.pole_coulomb == pytest.approx(3e-4)
    assert EmulatorSettings().of_cart({**file, "latency": 0.0}).latency == 0.0
    with pytest.raises(ConfigError, match=r"of cart=: emulator\.force_asymmetry=0\.91: give at most 0\.9$"):
        EmulatorSettings().of_cart({**file, "force_asymmetry": 0.88})


def test_what_was_given_stays_though_it_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("cart_viscous: 0.65\n")
    words = [f"emulator={tmp_path}/mine.yaml", "emulator.backdrivability=1.0", "cart=stepper"]
    config = compose("emulate", words)
    stepper = EmulatorSettings(**config["emulator"]).of_cart(config["cart"])
    assert (stepper.backdrivability, stepper.cart_viscous) == (1.0, 0.65)
    assert EmulatorSettings().of_cart(config["cart"]).backdrivability == 0.0
    with pytest.raises(ConfigError, match="cart_mass is -1; it must be above 0"):
        EmulatorSettings().of_cart({"cart_mass": -1.0})
    with pytest.raises(
        ConfigError, match=r"cart.hard_pus: there is no such setting; did you mean cart.hard_push"
    ):
        EmulatorSettings().of_cart({"hard_pus": 3.0})


def test_the_cart_that_was_identified_is_emulated(tmp_path: Path) -> None:
    """An agent of its identification has other numbers on the same rig."""
    file = choice("cart/sensorsini")
    identified = {**file, "cart_viscous": 1.3 * file["cart_viscous"], "latency": 0.0}
    (tmp_path / "mine.yaml").write_text("defaults: [sensorsini]\n")
    emulator = EmulatorSettings(**choice("emulator/sensorsini"))
    truth = emulator.of_cart(file)
    assert emulator.of_cart(identified) == truth
    own = EmulatorSettings(**{**choice("emulator/sensorsini"), "cart": f"{tmp_path}/mine.yaml"})
    (tmp_path / "mine.yaml").unlink()  # its numbers are recorded
    assert own.of_cart(identified) == truth.model_copy(update={"cart": file})
    assert EmulatorSettings.model_validate_json(own.model_dump_json()) == own
    assert EmulatorSettings().of_cart(identified).cart_viscous == pytest.approx(1.3 * truth.cart_viscous)
    with pytest.raises(
        ConfigError, match=r"^emulator\.cart: it has \w+ [\d.]+, but the cart of .* [\d.]+; give"
    ):
        own.of_cart(choice("cart/stepper"))
    with pytest.raises(ConfigError, match=r"^emulator\.cart=other\.yaml: there is no such file$"):
        EmulatorSettings(cart="other.yaml")


def test_another_rig_than_the_given_one_is_refused() -> None:
    cart = EmulatorSettings(hardware=hardware_of({"track_span": 0.5}))
    assert cart.of_cart({"track_span": 0.5}) is cart
    with pytest.raises(ConfigError, match=r"^emulator\.hardware: it differs from the rig of cart=; leave it"):
        cart.of_cart({})
