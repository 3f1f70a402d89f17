"""The rules of both firmwares one by one, with artificial encoder counts and without physics."""

import json
from pathlib import Path

import pytest
from firmwares import Bench, make_firmware

from cartpole_rl.wire.frames import FrameSplitter
from cartpole_rl.wire.messages import (
    Ack,
    ClearFault,
    Fault,
    FaultReport,
    Flags,
    Hello,
    Home,
    Info,
    MessageType,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    State,
    Stop,
)

pytestmark = pytest.mark.usefixtures("each_firmware")

SOFT, HARD = 16704, 17539  # counts, of the nominal track
VECTORS = json.loads((Path(__file__).parents[1] / "wire" / "vectors.json").read_text(encoding="utf-8"))


@pytest.fixture
def bench() -> Bench:
    """Return a homed and armed cart."""
    bench = Bench()
    assert bench.send(Start()) == Ack(0, MessageType.START)
    return bench


def test_a_cart_boots_idle_with_the_motor_at_zero():
    state, flags = Bench(homed=False).tick()
    assert state == State(1, 20_000, 0, 0, 0, 0, 0, 65535)
    assert flags == Flags(0)


def test_start_arms_and_stop_disarms(bench):
    assert bench.tick()[1] == Flags.ARMED | Flags.HOMED
    bench.send(SetMotor(100))
    assert bench.tick()[0].motor_applied == 100
    assert bench.send(Stop()) == Ack(2, MessageType.STOP)
    state, flags = bench.tick()
    assert state.motor_applied == 0
    assert flags == Flags.HOMED
    assert bench.motors[-1] == (40_000, 0)


def test_motor_is_refused_unless_armed_and_in_range(bench):
    assert Bench().refusal(SetMotor(1)) == Reason.NOT_ARMED
    assert bench.refusal(SetMotor(256)) == bench.refusal(SetMotor(-256)) == Reason.OUT_OF_RANGE
    assert bench.send(SetMotor(255)) is None
    assert bench.send(SetMotor(-255)) is None


def test_state_reports_the_newest_accepted_frame_and_its_age(bench):
    bench.send(SetMotor(10))
    state, _ = bench.tick()
    assert (state.last_sequence, state.command_age_ms) == (1, 20)
    assert bench.refusal(SetMotor(1000)) == Reason.OUT_OF_RANGE
    state, _ = bench.tick()
    assert (state.last_sequence, state.command_age_ms) == (1, 40)
    bench.send(Hello())
    assert bench.tick()[0].last_sequence == 3


def test_a_command_comes_into_force_after_its_latency():
    bench = Bench(latency_us=3_000)
    bench.send(Start())
    bench.send(SetMotor(100))
    bench.tick()
    assert bench.motors == [(0, 0), (3_000, 100)]
    bench.send(SetMotor(-50))
    bench.tick()
    assert bench.motors == [(20_000, 100), (23_000, -50)]


def test_a_latency_of_more_than_a_period_keeps_the_order():
    latencies = iter([50_000, 10_000])
    bench = Bench()
    bench.firmware = make_firmware(lambda: next(latencies), homed=True)
    bench.send(Start())
    bench.send(SetMotor(100))
    bench.tick()
    bench.send(SetMotor(-100))
    motors = []
    for _ in range(3):
        bench.tick()
        motors += bench.motors
    assert motors == [(20_000, 0), (40_000, 0), (50_000, -100), (60_000, -100)]


def test_stop_discards_pending_commands():
    bench = Bench(latency_us=30_000)
    bench.send(Start())
    bench.send(SetMotor(100))
    bench.send(Stop())
    for _ in range(3):
        assert bench.tick()[0].motor_applied == 0


def test_watchdog_stops_the_motor_after_three_periods_and_a_command_revives_it(bench):
    bench.send(SetMotor(100))
    states = [bench.tick() for _ in range(5)]
    assert [state.motor_applied for state, _ in states] == [100, 100, 0, 0, 0]
    assert [bool(flags & Flags.WATCHDOG) for _, flags in states] == [False, False, True, True, True]
    assert states[-1][1] & Flags.ARMED
    bench.send(SetMotor(-100))
    state, flags = bench.tick()
    assert state.motor_applied == -100
    assert not flags & Flags.WATCHDOG


def test_other_or_refused_frames_do_not_reset_the_watchdog(bench):
    bench.send(SetMotor(100))
    for message in (Hello(), SetMotor(300), Start()):
        bench.send(message)
        state, _ = bench.tick()
    assert state.motor_applied == 0


@pytest.mark.parametrize("side", [1, -1])
def test_soft_limit_lets_the_cart_in_and_not_out(bench, side):
    bench.send(SetMotor(side * 100))
    state, flags = bench.tick(side * (SOFT - 1))
    assert state.motor_applied == side * 100
    assert not flags & Flags.SOFT_LIMIT
    bench.send(SetMotor(side * 100))
    state, flags = bench.tick(side * SOFT)
    assert state.motor_applied == 0
    assert flags & Flags.SOFT_LIMIT
    bench.send(SetMotor(-side * 100))
    assert bench.tick(side * (SOFT + 5))[1] & Flags.SOFT_LIMIT  # at the beginning of this period
    bench.send(SetMotor(-side * 100))
    state, flags = bench.tick(side * (SOFT + 5))
    assert state.motor_applied == -side * 100
    assert not flags & Flags.SOFT_LIMIT
    assert state.fault == 0


@pytest.mark.parametrize("side", [1, -1])
def test_the_soft_limit_holds_from_the_first_command_on(side):
    bench = Bench()
    bench.tick(side * SOFT)
    bench.send(Start())
    bench.send(SetMotor(side * 255))
    _, flags = bench.tick(side * SOFT)
    assert {motor for _, motor in bench.motors} == {0}
    assert flags & Flags.SOFT_LIMIT
    bench.send(SetMotor(-side * 255))
    assert bench.tick(side * SOFT)[0].motor_applied == -side * 255


@pytest.mark.parametrize("side", [1, -1])
def test_hard_limit_latches_until_it_is_cleared(side):
    bench = Bench()
    for _ in range(10):
        bench.tick(side * (HARD - 1))
    bench.send(Start())
    bench.send(SetMotor(-side * 100))
    report, state = bench.frames(side * HARD)
    assert report.message == FaultReport(Fault.HARD_LIMIT, 11)
    assert (report.sequence, state.sequence) == (11, 12)
    assert state.message.fault == Fault.HARD_LIMIT
    assert state.message.motor_applied == 0
    assert Flags(state.flags) == Flags.HOMED | Flags.FAULTED
    for _ in range(26):  # until the cart rests, when a hand may move it
        assert len(bench.frames(side * HARD)) == 1  # reported once, though still latched
    assert bench.refusal(Start()) == Reason.FAULT_LATCHED
    assert bench.refusal(SetMotor(1)) == Reason.FAULT_LATCHED
    assert bench.refusal(Home()) == Reason.FAULT_LATCHED
    assert isinstance(bench.send(ClearFault()), Ack)
    for _ in range(10):
        bench.tick(0)
    assert isinstance(bench.send(Start()), Ack)
    state, flags = bench.tick(0)
    assert state.fault == 0
    assert flags == Flags.ARMED | Flags.HOMED


def test_a_disarmed_cart_may_be_anywhere():
    assert Bench().tick(HARD + 100)[0].fault == 0


def push(bench: Bench, motors: list[int], counts: list[int]) -> State:
    """Drive a cart with a hanging pole to given counts; return the last STATE."""
    for motor, cart in zip(motors, counts, strict=True):
        bench.send(SetMotor(motor))
        state, _ = bench.tick(cart, 2048)
    return state


def test_stall_is_a_hard_push_that_moves_hardly_anything(bench):
    assert push(bench, [255] * 25, [3, 5] * 12 + [3]).fault == 0
    assert push(bench, [255] * 2, [5, 3]).fault == Fault.STALL


def test_a_count_that_stands_still_under_hard_pushes_is_a_fault_and_the_brake_ends_when_it_moves(bench):
    assert push(bench, [255] * 3, [3] * 3).fault == 0
    state = push(bench, [255] * 4, [3] * 4)
    assert state.fault == Fault.CART_ENCODER
    assert state.motor_applied == -255
    assert bench.tick(2)[0].motor_applied == -255
    assert bench.tick(1)[0].motor_applied == 0


def test_a_count_that_jumps_and_then_stands_still_is_never_braked(bench):
    now_us = bench.now_us
    for look, cart in enumerate([0] * 9 + [300] + [2_000_000] * 10):
        bench.firmware.look(now_us + 1000 * look, cart, 2048)
    assert bench.firmware.fault == Fault.CART_ENCODER
    assert bench.firmware.motor == 0


@pytest.mark.parametrize(
    ("cart", "pole", "fault"),  # a period of 20 ms allows 0.1 m, or 4395 counts
    [(cart, 0, Fault.CART_ENCODER) for cart in (8_000, -8_000, 2_000)] + [(0, 600, Fault.POLE_ENCODER)],
)
def test_a_jump_of_a_count_is_seen_at_once_and_the_brake_does_not_answer_it(bench, cart, pole, fault):
    bench.tick()
    for look in range(1, 20):
        bench.firmware.look(bench.now_us + 1000 * look, *((0, 0) if look < 10 else (cart, pole)))
        assert bench.firmware.motor == 0
        assert bench.firmware.fault == (Fault.NONE if look < 10 else fault)
    assert bench.tick(cart, pole)[0].fault == fault


def test_a_hand_may_move_the_pole_until_the_cart_is_armed(bench):
    bench.tick()
    bench.send(Stop())
    for look in range(1, 20):
        if look == 10:
            bench.send(Start())
        bench.firmware.look(bench.now_us + 1000 * look, 0, 600 if look >= 10 else 0)
    assert bench.firmware.fault == Fault.NONE


@pytest.mark.parametrize(
    ("motors", "counts"),
    [
        ([255] * 100, [10 * tick for tick in range(100)]),  # it creeps at 1 cm/s
        ([150] * 100, [0] * 100),  # not hard enough to be sure
        ([255, -255] * 50, [0, 2] * 50),  # to and fro too fast to move far
        (([255] * 20 + [0] * 2) * 4, [0, 2] * 44),  # short pushes
    ],
)
def test_a_weaker_or_shorter_push_is_not_a_stall(bench, motors, counts):
    assert push(bench, motors, counts).fault == 0


@pytest.mark.parametrize(
    ("counts", "fault"), [((5_000, 0), Fault.CART_ENCODER), ((0, 2_000), Fault.POLE_ENCODER)]
)
def test_a_count_that_jumps_is_a_fault_and_invalidates_the_zeros(bench, counts, fault):
    bench.tick(0, 0)
    state, flags = bench.tick(*counts)
    assert state.fault == fault
    assert flags == Flags.FAULTED
    bench.send(ClearFault())
    assert bench.refusal(Start()) == Reason.NOT_HOMED


def test_the_fastest_cart_and_pole_are_no_fault(bench):
    for tick in range(20):
        bench.send(SetMotor(0))
        state, _ = bench.tick(-16_000 + 1_600 * tick, 500 * tick)  # 1.8 m/s, 38 rad/s
        assert state.fault == 0


def test_homing_is_busy_moves_by_itself_and_is_ended_by_stop():
    bench = Bench(homed=True)
    assert isinstance(bench.send(Home()), Ack)
    motors = []
    for _ in range(10):
        state, flags = bench.tick()
        motors.append(state.motor_applied)
    assert flags == Flags.HOMING
    assert motors[-1] < 0
    for message in (Start(), SetMotor(5), Home(), SetPeriod(10_000)):
        assert bench.refusal(message) == Reason.BUSY
    assert isinstance(bench.send(Hello()), Info)
    assert isinstance(bench.send(Stop()), Ack)
    state, flags = bench.tick()
    assert state.motor_applied == 0
    assert flags == Flags(0)
    assert bench.refusal(Start()) == Reason.NOT_HOMED


def test_a_cart_that_cannot_move_fails_to_home():
    bench = Bench(homed=False)
    bench.send(Home())
    faults = []
    for _ in range(600):
        bench.send(Hello())
        faults.append(bench.tick()[0].fault)
    assert faults[0] == 0
    assert faults[-1] == Fault.HOMING
    assert bench.refusal(Home()) == Reason.FAULT_LATCHED


@pytest.mark.parametrize("way", [1, -1])
def test_homing_ends_when_the_cart_moves_the_wrong_way(way):
    """A motor or an encoder is reversed: motor values to the left increase the count.

    A healthy cart may roll the wrong way at first.
    """
    bench, counts, speed = Bench(homed=False), 0.0, 500.0 if way < 0 else 0.0
    bench.send(Home())
    motor = 0
    for _ in range(150):
        speed += -way * motor * 0.7 if abs(motor) > 50 else -0.1 * speed  # counts a period; 200: 3.5 m/s^2
        counts += speed
        state, _ = bench.tick(round(counts))
        motor = state.motor_applied
        if state.fault:
            break
    if way > 0:
        assert state.fault == Fault.HOMING
        assert counts < 0.06 / 22.749e-6
        assert motor == 0
    else:
        assert state.fault == 0
        assert counts > 0.02 / 22.749e-6 or speed < 0


@pytest.mark.parametrize(("counts_a_second", "fault"), [(10_000, 0), (1_000, Fault.HOMING)])
def test_homing_goes_on_while_a_fast_pole_pushes_the_cart_the_wrong_way(counts_a_second, fault):
    """As after an episode whose pole turned over: such a pole is stronger than the motor."""
    bench, counts, speed, state = Bench(homed=False), 0, 0, None
    bench.send(Home())
    for number in range(20):
        speed += 15
        counts += speed
        state, _ = bench.tick(counts, number * counts_a_second // 50)
    assert counts > 0.06 / 22.749e-6
    assert state.fault == fault


def test_an_armed_cart_is_not_homed_or_retimed(bench):
    assert bench.refusal(Home()) == Reason.BUSY
    assert bench.refusal(SetPeriod(10_000)) == Reason.BUSY


@pytest.mark.parametrize("vector", [pytest.param(one, id=one["name"]) for one in VECTORS["damaged"]])
def test_a_damaged_frame_gets_no_answer_and_changes_nothing(bench, vector):
    idle = Bench()
    for stuffed in FrameSplitter().feed(bytes.fromhex(vector["hex"])):
        assert bench.firmware.receive(stuffed, 0) == idle.firmware.receive(stuffed, 0) == []
    state, flags = bench.tick()
    assert (state.motor_applied, state.last_sequence, flags) == (0, 0, Flags.ARMED | Flags.HOMED)
    assert idle.tick()[1] == Flags.HOMED


def test_a_booted_cart_answers_byte_for_byte_according_to_the_vectors():
    firmware, splitter = make_firmware(lambda: 0), FrameSplitter()
    for vector in VECTORS["dialogue"]:
        runs = splitter.feed(bytes.fromhex(vector["send"]))
        answer = b"".join(frame for stuffed in runs for frame in firmware.receive(stuffed, 0))
        assert answer.hex(" ") == vector["answer"], vector["name"]


def test_the_cart_numbers_its_frames_modulo_256():
    bench = Bench()
    sequences = []
    for _ in range(150):
        bench.send(Hello())
        sequences.append(bench.frames()[0].sequence)
    assert sequences == [(2 * number + 1) % 256 for number in range(150)]
