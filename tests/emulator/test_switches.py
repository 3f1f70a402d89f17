"""Carts with end switches: both firmwares home by them, and stop where one is not as it can be."""

import math
from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from driven_cart import Driven, homed
from firmwares import needs_compiler

from cartpole_rl.emulator.physics import STOP_BEHIND
from cartpole_rl.rig.hardware import hardware_of
from cartpole_rl.wire.messages import ClearFault, Fault, Flags, Hello, Home, SetMotor, SetPeriod, Start, State

LEFT, RIGHT, BOTH = 1, 2, 3
HAS_BOTH = Flags.LEFT_SWITCH | Flags.RIGHT_SWITCH
HALF = 0.2  # m, of the emulated track; that of the rig is 0.198
each_firmware = pytest.mark.usefixtures("each_firmware")


def settings_of(switches: int) -> dict[str, Any]:
    rig = hardware_of({"left_switch": switches & 1, "right_switch": switches >> 1, "track_span": 0.396})
    return {"hardware": rig, "track_half_length": HALF}


def reads(driven: Driven, switches: Callable[[float], int]) -> None:
    """Let the switches read what a function of the cart's place returns."""
    physics = driven.cart.physics
    physics._press_switches = lambda x: setattr(physics, "switches", switches(x))


def home_from(place: float, switches: int, firmware: str, period_us: int) -> tuple[Driven, State, float]:
    """Return the homed cart, its state, and how far from the middle it came, in m."""
    driven = Driven(**settings_of(switches) | {"firmware": firmware})
    driven.cart.physics.place(place, math.pi)
    driven.ask(SetPeriod(period_us))
    state, farthest = driven.ask(Home()), 0.0
    while driven.flags & Flags.HOMING:
        state = driven.ask(Hello())
        farthest = max(farthest, abs(driven.x))
    return driven, state, farthest


@needs_compiler
@pytest.mark.parametrize(
    ("switches", "place", "period_us"),
    [
        *((switches, 0.03, 20_000) for switches in (BOTH, LEFT, RIGHT)),
        *((switches, -HALF - 0.0035, 20_000) for switches in (BOTH, LEFT, RIGHT)),
        *((switches, HALF + 0.0035, 5_000) for switches in (BOTH, RIGHT)),  # on the right one
        (BOTH, 0.03, 100_000),
    ],
)
def test_both_firmwares_find_the_same_ends(switches: int, place: float, period_us: int) -> None:
    driven, state, farthest = home_from(place, switches, "python", period_us)
    c, same, _ = home_from(place, switches, "c", period_us)
    assert (driven.flags, state.fault) == (Flags.HOMED | switches * Flags.LEFT_SWITCH, Fault.NONE)
    assert (c.flags, c.info(), same) == (driven.flags, driven.info(), state)
    half = HALF if switches == BOTH else 0.198
    middle = {BOTH: 0.0, LEFT: half - HALF, RIGHT: HALF - half}[switches]
    found = driven.limits()[1] * driven.encoders.metres + 0.008
    assert found == pytest.approx(half, abs=2e-4)
    assert driven.measured(state)[0] == pytest.approx(driven.x - middle, abs=2e-4)
    if period_us <= 20_000:
        assert farthest < HALF + STOP_BEHIND


LIES: dict[str, tuple[int, Callable[[float], int], Fault]] = {
    "left dead": (LEFT, lambda x: 0, Fault.LEFT_SWITCH),
    "right dead": (RIGHT, lambda x: 0, Fault.RIGHT_SWITCH),
    "second dead": (BOTH, lambda x: LEFT * (x < -HALF), Fault.RIGHT_SWITCH),
    "left stuck": (LEFT, lambda x: LEFT, Fault.LEFT_SWITCH),
    "left stuck of both": (BOTH, lambda x: LEFT, Fault.LEFT_SWITCH),
    "right stuck": (BOTH, lambda x: RIGHT, Fault.RIGHT_SWITCH),
    "both stuck": (BOTH, lambda x: BOTH, Fault.LEFT_SWITCH | Fault.RIGHT_SWITCH),
    "swapped": (BOTH, lambda x: RIGHT * (x < -HALF) + LEFT * (x > HALF), Fault.RIGHT_SWITCH),
    "left on the way right": (BOTH, lambda x: LEFT * (x < -HALF or x > 0.1), Fault.LEFT_SWITCH),
    "both at the right": (
        BOTH,
        lambda x: LEFT if x < -HALF else BOTH * (x > HALF),
        Fault.LEFT_SWITCH | Fault.RIGHT_SWITCH,
    ),
}


@each_firmware
@pytest.mark.parametrize(("switches", "reading", "fault"), LIES.values(), ids=LIES)
def test_a_switch_that_lies_ends_homing(switches: int, reading: Callable[[float], int], fault: Fault) -> None:
    driven = Driven(**settings_of(switches))
    reads(driven, reading)
    state = driven.home()
    assert (driven.flags, state.motor_applied) == (Flags.FAULTED | switches * Flags.LEFT_SWITCH, 0)
    assert Fault(state.fault) == Fault.HOMING | fault


@each_firmware
@pytest.mark.parametrize("switches", [LEFT, BOTH], ids=["one", "both"])
@pytest.mark.parametrize("quiet", [5, 99, 110, 450], ids=["hanging", "brake", "braking", "wait"])  # periods
def test_a_switch_that_is_pressed_in_the_middle_ends_homing_at_once(quiet: int, switches: int) -> None:
    """Counted from the end of the way to the middle, after the right end."""
    driven = Driven(**settings_of(BOTH))
    driven.cart.physics.place(0.03, math.pi - 1.2)
    state, right, periods = driven.ask(Home()), False, 0
    while driven.flags & Flags.HOMING:
        right |= driven.x > HALF
        periods += right and (periods > 0 or (abs(driven.x) < 0.01 and state.motor_applied == 0))
        if periods == quiet:
            driven.cart.physics._press_switches = lambda x: setattr(driven.cart.physics, "switches", switches)
        assert periods <= quiet + 2
        state = driven.ask(Hello())
    assert Fault(state.fault) == Fault.HOMING | Fault(switches * Fault.LEFT_SWITCH)


@each_firmware
@pytest.mark.parametrize("side", [-1, 1])
def test_a_cart_whose_counts_slipped_is_stopped_by_a_switch(side: int) -> None:
    driven = homed(**settings_of(BOTH))
    cart, pole = driven.cart._boot
    driven.cart._boot = (cart + side * driven.encoders.cart_counts(0.06), pole)
    driven.tick()
    state = driven.ask(Start())
    while not state.fault:
        assert abs(state.cart_counts) < driven.limits()[0]
        state = driven.ask(SetMotor(110 * side))
    assert state.fault == Fault.HARD_LIMIT | (Fault.RIGHT_SWITCH if side > 0 else Fault.LEFT_SWITCH)
    assert driven.flags & ~Flags.SOFT_LIMIT == Flags.FAULTED | HAS_BOTH  # not homed: its zeros are wrong
    assert state.motor_applied == -side * 255
    states = [driven.tick() for _ in range(50)]
    assert states[-1].motor_applied == 0
    assert driven.cart.physics.x_dot == pytest.approx(0, abs=1e-3)


@each_firmware
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("both", [False, True], ids=["at the far end", "both"])
def test_a_false_press_lets_no_cart_run_into_its_end(both: bool, side: int) -> None:
    driven = homed(**settings_of(BOTH))
    false = BOTH if both else LEFT if side > 0 else RIGHT
    reads(driven, lambda x: false * (side * x > 0.08))
    state, farthest, braked = driven.ask(Start()), 0.0, False
    while not state.fault:
        state = driven.ask(SetMotor(255 * side))
    assert side * driven.cart.physics.x_dot > 0.3
    for _ in range(100):
        braked |= state.motor_applied == -255 * side
        farthest = max(farthest, side * driven.x)
        state = driven.tick()
    assert state.fault == Fault.HARD_LIMIT | Fault(false * Fault.LEFT_SWITCH)
    assert braked
    assert state.motor_applied == 0
    assert farthest < HALF


@each_firmware
def test_a_cart_that_does_not_leave_its_switch_ends_homing_within_seconds() -> None:
    driven = Driven(**settings_of(LEFT))
    reads(driven, lambda x: LEFT)
    shake, (cart, pole) = driven.encoders.cart_counts(0.001), driven.cart._counts()
    driven.cart._counts = lambda: (cart + shake * (driven.newest % 2), pole)
    state = driven.home()
    assert state.fault == Fault.HOMING | Fault.LEFT_SWITCH
    assert driven.cart.now_us / 1e6 == pytest.approx(5, abs=0.1)


@each_firmware
def test_a_cart_armed_on_a_switch_faults_in_that_period() -> None:
    driven = homed(**settings_of(LEFT))
    reads(driven, lambda x: LEFT)
    assert driven.tick().fault == 0
    assert driven.ask(Start()).fault == Fault.HARD_LIMIT | Fault.LEFT_SWITCH
    assert not driven.flags & (Flags.ARMED | Flags.HOMED)
    driven.ask(ClearFault())
    assert driven.home().fault == Fault.HOMING | Fault.LEFT_SWITCH


@each_firmware
def test_noise_at_one_look_is_no_pressed_switch() -> None:
    driven = homed(**settings_of(BOTH))
    driven.ask(Start())
    firmware, now_us = driven.cart.firmware, driven.cart.now_us
    counts = driven.cart._counts()
    for look, switches in enumerate([BOTH, 0, LEFT, RIGHT, 0, LEFT]):
        firmware.switches = switches
        firmware.look(now_us + look + 1, *counts)
    assert firmware.fault == Fault.NONE
    firmware.look(now_us + 9, *counts)
    assert firmware.fault == Fault.HARD_LIMIT | Fault.LEFT_SWITCH


@each_firmware
def test_a_rig_without_switches_reads_none() -> None:
    driven = homed()
    driven.ask(Start())
    reads(driven, lambda x: BOTH)
    assert driven.tick().fault == driven.tick().fault == 0
