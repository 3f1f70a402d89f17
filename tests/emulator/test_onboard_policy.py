"""A policy on the board drives from START on, under all rules, until the host takes over."""

import ctypes
from collections.abc import Callable
from pathlib import Path

import pytest
from driven_cart import Driven
from firmwares import needs_compiler

from cartpole_rl.emulator.c_firmware import CFirmware
from cartpole_rl.emulator.c_library import build_library
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import EmulatorError
from cartpole_rl.wire import Fault, Flags, Hello, SetMotor, Start, State, Stop, decode_frame, encode_frame
from cartpole_rl.wire.messages import Message

pytestmark = needs_compiler
SOFT = 16704  # counts, of the nominal track


class Observation(ctypes.Structure):
    """`cart_observation` of firmware/src/cart.h."""

    _fields_ = (
        ("cart_counts", ctypes.c_int32),
        ("pole_counts", ctypes.c_int32),
        ("soft_limit", ctypes.c_int32),
        ("period_us", ctypes.c_uint32),
        ("first", ctypes.c_bool),
    )


SHUTTLE = Path(__file__).parents[1] / "support" / "shuttle"
PolicyInC = ctypes.CFUNCTYPE(ctypes.c_int16, ctypes.c_void_p, ctypes.POINTER(Observation))


class Board:
    """A homed and armed cart whose policy is a Python function."""

    def __init__(self, choose: Callable[[Observation], int]) -> None:
        self.observed: list[tuple[int, int, int, int, bool]] = []

        def called(memory: int, pointer: "ctypes._Pointer[Observation]") -> int:
            seen = pointer.contents
            self.observed.append(tuple(getattr(seen, name) for name, _ in Observation._fields_))
            return choose(seen)

        self._called = PolicyInC(called)
        self.firmware = CFirmware(lambda: 0)
        self.firmware._head.policy = ctypes.cast(self._called, ctypes.c_void_p)
        self.firmware.homed = True
        self.now_us = 0
        self.send(Start())

    def send(self, message: Message) -> None:
        self.firmware.receive(encode_frame(message, 1)[:-1], self.now_us)

    def tick(self, cart: int = 0, pole: int = 0) -> tuple[State, Flags, int]:
        """Pass a period; return STATE, its flags, and the motor value in force after it."""
        start_us, self.now_us = self.now_us, self.now_us + self.firmware.period_us
        self.firmware.drive(start_us, self.now_us)
        frame = decode_frame(self.firmware.tick(self.now_us, cart, pole)[-1][:-1])
        assert isinstance(frame.message, State)
        ((_, motor),) = self.firmware.drive(self.now_us, self.now_us + 1)
        return frame.message, Flags(frame.flags), motor


def test_it_observes_each_period_and_chooses_after_state():
    board = Board(lambda seen: seen.cart_counts // 10)
    ticks = [board.tick(cart, pole) for cart, pole in ((500, 7), (-900, 8), (300, -5))]
    assert [motor for *_, motor in ticks] == [50, -90, 30]
    assert [state.motor_applied for state, *_ in ticks] == [0, 50, -90]
    assert board.observed == [
        (500, 7, SOFT, 20_000, True),
        (-900, 8, SOFT, 20_000, False),
        (300, -5, SOFT, 20_000, False),
    ]


def test_it_needs_no_host_and_no_watchdog_stops_it():
    board = Board(lambda seen: 100)
    for period in range(100):
        _, flags, motor = board.tick(10 * period)
        assert (flags, motor) == (Flags.ARMED | Flags.HOMED, 100)


def test_a_motor_value_of_the_host_takes_over_until_the_next_start():
    board = Board(lambda seen: 100)
    board.tick()
    board.send(SetMotor(-30))
    assert [board.tick()[2] for _ in range(4)] == [-30, -30, 0, 0]  # the watchdog guards the host
    assert board.tick()[1] & Flags.WATCHDOG
    board.send(Stop())
    assert board.tick()[2] == 0
    board.send(Start())
    assert board.tick()[2] == 100
    assert board.observed[-1][-1]  # first


def test_stop_ends_it_and_a_disarmed_board_asks_nothing():
    board = Board(lambda seen: 100)
    board.tick()
    board.send(Stop())
    assert [board.tick()[2] for _ in range(3)] == [0, 0, 0]
    assert len(board.observed) == 1


@pytest.mark.parametrize("side", [1, -1])
def test_the_soft_limit_holds_for_it(side):
    board = Board(lambda seen: side * 100)
    board.tick(side * (SOFT - 200))
    state, flags, motor = board.tick(side * SOFT)
    assert (state.motor_applied, motor) == (0, 0)
    assert flags & Flags.SOFT_LIMIT
    assert board.tick(side * (SOFT - 100))[2] == side * 100


def test_a_fault_ends_it():
    board = Board(lambda seen: 255)
    states = [board.tick(5) for _ in range(30)]
    assert states[-1][0].fault == Fault.STALL
    assert states[-1][2] == 0
    asked = len(board.observed)
    board.tick(5)
    assert len(board.observed) == asked < 30


@pytest.mark.parametrize("value", [256, -256, 32767, -32768])
def test_a_value_out_of_range_is_0(value):
    assert Board(lambda seen: value).tick()[2] == 0


def test_an_emulated_cart_drives_by_the_c_code_of_a_policy():
    """The cart shuttles about the middle without a motor value from the host."""
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    driven = Driven(firmware="c", policy=SHUTTLE)
    driven.home()
    driven.ask(Start())
    states = [driven.ask(Hello()) for _ in range(200)]
    assert {state.motor_applied for state in states} == {110, -110}
    assert min(state.cart_counts for state in states) < -50
    assert max(state.cart_counts for state in states) > 50
    assert driven.flags == Flags.ARMED | Flags.HOMED


def test_a_policy_needs_the_c_firmware():
    with pytest.raises(ValueError, match="set firmware=c"):
        EmulatorSettings(policy=SHUTTLE)


def test_a_folder_without_a_policy_is_named(tmp_path):
    with pytest.raises(EmulatorError, match=r"emulator.policy=.*: there is no policy.h; give a folder"):
        build_library(tmp_path)
