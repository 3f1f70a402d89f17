"""A policy on the board drives from START_POLICY on, under all rules, until the host takes over."""

import ctypes
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import pytest
from driven_cart import Driven
from firmwares import Bench, needs_compiler

from cartpole_rl.emulator.c_firmware import CFirmware, build_library, compile_c
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import EmulatorError
from cartpole_rl.wire.frames import encode_frame
from cartpole_rl.wire.messages import (
    Ack,
    Fault,
    Flags,
    Hello,
    Message,
    MessageType,
    Nack,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    StartPolicy,
    State,
    Stop,
)

pytestmark = needs_compiler
SOFT = 16704  # counts, of the nominal track
START_POLICY = StartPolicy()


class Observation(ctypes.Structure):
    """`cart_observation` of firmware/src/cart.h."""

    _fields_ = (
        ("cart_counts", ctypes.c_int32),
        ("pole_counts", ctypes.c_int32),
        ("soft_limit", ctypes.c_int32),
        ("period_us", ctypes.c_uint32),
        ("set_period_us", ctypes.c_uint32),
        ("first", ctypes.c_bool),
        ("resumed", ctypes.c_bool),
        ("motor", ctypes.c_int16),
    )


SHUTTLE = Path(__file__).parents[1] / "support" / "shuttle"
PolicyInC = ctypes.CFUNCTYPE(ctypes.c_int16, ctypes.c_void_p, ctypes.POINTER(Observation))


class Board(Bench):
    """A homed cart whose policy is a Python function and drives, unless `start` is another message."""

    def __init__(self, choose: Callable[[Observation], int], start: Message = START_POLICY) -> None:
        super().__init__()
        self.observed: list[tuple[int, int, int, int, int, bool, bool, int]] = []

        def called(memory: int, pointer: "ctypes._Pointer[Observation]") -> int:
            seen = pointer.contents
            self.observed.append(tuple(getattr(seen, name) for name, _ in Observation._fields_))
            return choose(seen)

        self._called = PolicyInC(called)
        self.firmware = CFirmware(lambda: 0)
        self.firmware._head.policy = ctypes.cast(self._called, ctypes.c_void_p)
        self.firmware.homed = True
        self.send(start)

    def heard(self, cart: int = 0, pole: int = 0) -> tuple[State, Flags, int]:
        """Pass a period in which the host sends HELLO."""
        self.send(Hello())
        return self.tick(cart, pole)

    def tick(self, cart: int = 0, pole: int = 0) -> tuple[State, Flags, int]:
        """Pass a period; return STATE, its flags, and the motor value in force after it."""
        return *super().tick(cart, pole), self.firmware.motor


def test_it_observes_each_period_and_chooses_after_state():
    board = Board(lambda seen: seen.cart_counts // 10)
    ticks = [board.heard(cart, pole) for cart, pole in ((500, 7), (-100, 8), (300, -5))]
    assert [motor for *_, motor in ticks] == [50, -10, 30]
    assert [state.motor_applied for state, *_ in ticks] == [0, 50, -10]
    assert board.observed == [
        (500, 7, SOFT, 20_000, 20_000, True, False, 0),
        (-100, 8, SOFT, 20_000, 20_000, False, False, 50),
        (300, -5, SOFT, 20_000, 20_000, False, False, -10),
    ]


def test_it_observes_what_a_limit_of_the_track_made_of_its_value():
    board = Board(lambda seen: 100, start=Stop())
    for _ in range(10):
        board.tick(SOFT + 5)
    board.send(START_POLICY)
    assert [board.heard(SOFT + 5)[2] for _ in range(3)] == [0, 0, 0]
    assert [motor for *_, motor in board.observed] == [0, 0, 0]


def test_any_accepted_frame_keeps_the_watchdog_quiet():
    board = Board(lambda seen: 100)
    for period in range(100):
        if period % 2:
            board.send(Hello())
        _, flags, motor = board.tick(10 * period)
        assert (flags, motor) == (Flags.ARMED | Flags.HOMED, 100)


@pytest.mark.parametrize("frame", [Hello(), START_POLICY], ids=["HELLO", "START_POLICY"])
def test_the_watchdog_stops_it_and_a_frame_revives_it(frame):
    board = Board(lambda seen: 100)
    ticks = [board.tick() for _ in range(6)]
    assert [motor for *_, motor in ticks] == [100, 100, 0, 0, 0, 0]
    assert [bool(flags & Flags.WATCHDOG) for _, flags, _ in ticks] == [False, False, True, True, True, True]
    assert len(board.observed) == 2
    assert isinstance(board.send(SetPeriod(10_000)), Nack)  # a refused frame revives nothing
    assert board.tick()[2] == 0
    board.send(frame)
    assert board.tick()[2] == board.heard()[2] == 100
    assert [seen[5:7] for seen in board.observed[1:]] == [(False, False), (False, True), (False, False)]


def test_start_never_asks_it():
    board = Board(lambda seen: 100, start=Start())
    assert [board.tick()[2] for _ in range(5)] == [0] * 5
    board.send(SetMotor(30))
    assert [board.tick()[2] for _ in range(4)] == [30, 30, 0, 0]
    assert board.observed == []


def test_start_takes_the_motor_over_with_motor_0():
    board = Board(lambda seen: 100)
    assert board.tick()[2] == 100
    assert board.send(Start()) == Ack(1, MessageType.START)
    state, flags, motor = board.tick()
    assert (state.motor_applied, motor) == (0, 0)
    assert flags & Flags.ARMED


def test_it_is_refused_where_start_is_and_on_a_cart_that_the_host_drives():
    board = Board(lambda seen: 100, start=Start())
    assert board.send(START_POLICY) == Nack(1, MessageType.START_POLICY, Reason.BUSY)
    board.send(Stop())
    for sequence in (3, 4):
        assert board.send(START_POLICY) == Ack(sequence, MessageType.START_POLICY)
    board.send(Stop())
    board.firmware.homed = False
    assert board.send(START_POLICY) == Nack(6, MessageType.START_POLICY, Reason.NOT_HOMED)
    assert board.send(Start()) == Nack(7, MessageType.START, Reason.NOT_HOMED)


def test_info_names_the_agent_on_the_board():
    board = Board(lambda seen: 100)
    board.firmware._head.policy_identity = 0x1A2B3C4D
    assert board.send(Hello()).policy == 0x1A2B3C4D
    board.firmware._head.policy = None
    assert board.send(Hello()).policy == 0


def test_a_motor_value_of_the_host_takes_over_until_the_next_start_policy():
    board = Board(lambda seen: 100)
    board.tick()
    board.send(SetMotor(-30))
    assert [board.tick()[2] for _ in range(4)] == [-30, -30, 0, 0]  # the watchdog guards the host
    assert board.tick()[1] & Flags.WATCHDOG
    board.send(Stop())
    assert board.tick()[2] == 0
    board.send(StartPolicy())
    assert board.tick()[2] == 100
    assert board.observed[-1][5:7] == (True, False)  # first, resumed


def test_it_is_told_of_a_watchdog_stop_that_ends_before_the_next_tick():
    board, motors = Board(lambda seen: 100), []
    board.tick()
    board.heard()
    board.tick()
    for board.now_us in range(61_000, 85_000, 1000):  # the next tick is late
        board.firmware.look(board.now_us, 0, 0)
        motors.append(board.firmware.motor)
        if board.now_us == 82_000:
            board.send(Hello())
    board.firmware.tick(85_000, 0, 0)
    assert motors == [100] * 19 + [0] * 5
    assert board.observed[-1][5:7] == (False, True)  # first, resumed


@pytest.mark.parametrize("side", [1, -1])
def test_the_soft_limit_holds_for_it(side):
    board = Board(lambda seen: side * 100)
    board.heard(side * (SOFT - 200))
    state, flags, motor = board.heard(side * SOFT)
    assert (state.motor_applied, motor) == (0, 0)
    assert flags & Flags.SOFT_LIMIT
    assert board.heard(side * (SOFT - 100))[2] == side * 100


def test_a_fault_ends_it():
    board = Board(lambda seen: 255)
    states = [board.heard(5) for _ in range(30)]
    assert states[-1][0].fault == Fault.CART_ENCODER
    assert states[-1][2] == 0
    asked = len(board.observed)
    board.tick(5)
    assert len(board.observed) == asked < 30


@pytest.mark.parametrize("value", [256, -32768])
def test_a_value_out_of_range_is_0(value):
    assert Board(lambda seen: value).tick()[2] == 0


def test_an_emulated_cart_drives_by_the_c_code_of_a_policy():
    """The cart shuttles about the middle without a motor value from the host."""
    pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')
    driven = Driven(firmware="c", policy=SHUTTLE)
    driven.home()
    driven.ask(StartPolicy())
    states = [driven.ask(Hello()) for _ in range(200)]
    assert {state.motor_applied for state in states} == {110, -110}
    assert min(state.cart_counts for state in states) < -50
    assert max(state.cart_counts for state in states) > 50
    assert driven.flags == Flags.ARMED | Flags.HOMED


def driving(policy: Path, pole_length: float = 0.25) -> CFirmware:
    """A homed cart that drives by the C code of a policy."""
    firmware = CFirmware(lambda: 0, policy=policy, pole_length=pole_length)
    firmware.homed = True
    firmware.receive(encode_frame(StartPolicy(), 1)[:-1], 0)
    return firmware


def changed(folder: Path, old: str, new: str) -> Path:
    """Write the policy of SHUTTLE, with a text replaced, into a folder; return the folder."""
    for file in ("policy.h", "policy.c"):
        text = (SHUTTLE / file).read_text(encoding="utf-8")
        folder.joinpath(file).write_text(text.replace(old, new), encoding="utf-8")
    return folder


def test_the_c_code_of_a_policy_gives_0_at_another_period():
    firmware = CFirmware(lambda: 0, policy=SHUTTLE, pole_length=0.3556)
    firmware.homed = True
    motors = []
    for number, period_us in enumerate((10_000, 20_000), start=1):
        firmware.tick(number * 100_000, 0, 2048)
        for message in (Stop(), SetPeriod(period_us), StartPolicy()):
            firmware.receive(encode_frame(message, 1)[:-1], number * 100_000)
        firmware.tick(number * 100_000 + period_us, 0, 2048)
        motors.append(firmware.motor)
    assert motors[0] == 0 != motors[1]


LENGTH = ("POLICY_OBSERVES_LENGTH 0", "POLICY_OBSERVES_LENGTH 1")


@pytest.mark.parametrize(
    ("change", "flag", "error"),
    [
        (
            ("POLICY_CART_NANOMETRES_PER_COUNT ", "POLICY_CART_NANOMETRES_PER_COUNT 1"),
            "",
            "for other encoders",
        ),
        (("POLICY_POLE_COUNTS_PER_TURN ", "POLICY_POLE_COUNTS_PER_TURN 1"), "", "for other encoders"),
        (LENGTH, "", "compile with -DCART_POLE_LENGTH="),
        (LENGTH, "-DCART_POLE_LENGTH=0.3556f", ""),
    ],
)
def test_a_policy_compiles_only_for_the_encoders_and_with_the_length_that_it_needs(
    change, flag, error, tmp_path
):
    changed(tmp_path, *change)
    board = tmp_path / "board.c"
    board.write_text(
        '#include "onboard.h"\nvoid boot(cart *self);\nvoid boot(cart *self) { onboard_attach(self); }\n'
    )
    with pytest.raises(EmulatorError, match=error) if error else nullcontext():
        compile_c(tmp_path / "none", [board], "-fsyntax-only", f"-I{tmp_path}", *filter(None, [flag]))


def test_the_c_code_of_a_policy_observes_the_length_of_the_emulated_pole(tmp_path):
    """A policy that returns its pole's length in mm as the motor value."""
    shutil.copy(SHUTTLE / "policy.h", tmp_path)
    tmp_path.joinpath("policy.c").write_text(
        '#include "policy.h"\n'
        "void policy_start(policy_t *policy, float track_end, float pole_length)\n"
        "{\n    policy->track_end = pole_length;\n}\n"
        "void policy_resume(policy_t *policy)\n{\n    (void)policy;\n}\n"
        "void policy_drove(policy_t *policy, int16_t motor)\n{\n    (void)policy, (void)motor;\n}\n"
        "int16_t policy_motor(policy_t *policy, int32_t cart_counts, int32_t pole_counts, float dt)\n"
        "{\n    (void)cart_counts, (void)pole_counts, (void)dt;\n"
        "    return (int16_t)(1000 * policy->track_end);\n}\n"
    )
    carts = [driving(tmp_path, length) for length in (0.25, 0.125)]
    for firmware in carts:
        firmware.tick(20_000, 0, 2048)
    assert [firmware.motor for firmware in carts] == [250, 125]


def test_a_policy_that_replaces_another_in_its_folder_is_compiled(tmp_path):
    motors = []
    for push in ("110", "90"):
        firmware = driving(changed(tmp_path, "PUSH 110", f"PUSH {push}"))
        firmware.tick(20_000, 0, 2048)
        motors.append(firmware.motor)
    assert motors == [110, 90]


def test_a_policy_needs_the_c_firmware():
    with pytest.raises(ValueError, match="set firmware=c"):
        EmulatorSettings(policy=SHUTTLE)


def test_a_folder_without_a_policy_is_named(tmp_path):
    with pytest.raises(EmulatorError, match=r"emulator.policy=.*: there is no policy.h; give a folder"):
        build_library(tmp_path)
