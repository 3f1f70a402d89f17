"""The emulator as its own process, over its real pseudo-terminal, spoken to with pyserial."""

import itertools
import signal
import statistics
import subprocess
import sys
import time

import pytest
import serial

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from emulator_host import SILENCE, EmulatorHost, emulator

from cartpole_rl.emulator.__main__ import read_settings
from cartpole_rl.emulator.firmware import BANNER
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.wire.frames import LONGEST_FRAME, encode_frame
from cartpole_rl.wire.messages import (
    Ack,
    Flags,
    Hello,
    Info,
    MessageType,
    Nack,
    Reason,
    SetMotor,
    Start,
    State,
    Stop,
)

COARSE = {"physics_step": 1e-3}

OVERFULL = 100  # frames, whose answers fill the line


def states_of(host: EmulatorHost, count: int) -> list[State]:
    return [host.state() for _ in range(count)]


def drive(seed: int) -> bytes:
    """All bytes that came while a cart was homed, driven and stopped over a bad cable."""
    bad = dict.fromkeys(("frame_loss", "frame_corruption", "frame_reordering", "frame_duplication"), 0.05)
    with emulator(**COARSE, **bad, seed=seed) as host:
        host.ask(Hello())
        host.home()
        host.ask(Start())
        for tick in range(100):
            host.ask(SetMotor(200 if tick // 10 % 2 else -200))
        host.ask(Stop())
        return host.came


def test_a_whole_lockstep_session():
    with emulator(**COARSE) as host:
        assert host.ready["pid"] == host.process.pid
        info, state = host.ask(Hello())
        assert isinstance(info.message, Info)
        assert state.message == State(1, 20_000, 0, 0, 0, 0, 0, 65535)
        assert host.ask(Start())[0].message == Nack(1, MessageType.START, Reason.NOT_HOMED)
        homed = host.home()
        assert Flags(homed.flags) == Flags.HOMED
        assert abs(homed.message.pole_counts - 2048) < 40
        assert isinstance(host.ask(Start())[0].message, Ack)
        before = host.ask(SetMotor(200))[-1].message
        after = host.ask(SetMotor(200))[-1].message
        assert after.tick == before.tick + 1
        assert after.time_us == before.time_us + 20_000
        assert after.motor_applied == 200
        assert after.cart_counts > before.cart_counts
        for motor, watchdog in ((200, False), (0, True), (0, True)):
            _, state = host.ask(Hello())
            assert state.message.motor_applied == motor
            assert bool(state.flags & Flags.WATCHDOG) == watchdog


def test_lockstep_repeats_byte_for_byte():
    first, again = drive(seed=3), drive(seed=3)
    length = min(len(first), len(again))  # the last answers may not have arrived
    assert length > 10_000
    assert first[:length] == again[:length]


@pytest.fixture(scope="module")
def shared():
    """An emulator in lockstep."""
    with emulator() as host:
        yield host


def tick(host: EmulatorHost) -> int:
    """Ask for a state; return its tick."""
    return host.ask(Hello())[-1].message.tick


def test_nothing_passes_by_itself_in_lockstep(shared):
    before = tick(shared)
    shared.serial.timeout = 0.3
    assert shared.serial.read(1) == b""
    shared.serial.timeout = SILENCE
    assert tick(shared) == before + 1


def test_one_undamaged_state_comes_for_each_frame_however_bad_the_cable():
    with emulator(frame_loss=0.3, frame_corruption=0.3) as host:
        ticks = [tick(host) for _ in range(200)]
    assert host.damaged > 20
    gaps = [after - before for before, after in itertools.pairwise(ticks)]
    assert min(gaps) == 1
    assert sum(gap > 1 for gap in gaps) > 50  # the cart ticked on while its states were lost


def test_at_least_one_state_comes_for_each_frame():
    with emulator(frame_reordering=0.3, frame_duplication=0.3) as host:
        for _ in range(150):
            host.send(Hello())
            host.state()
    assert len({*host.came.split(b"\x00")}) > 150


def test_garbage_passes_a_period_and_does_no_harm(shared):
    before = tick(shared)
    shared.serial.write(b"ets Jul 29 2019 12:21:46\r\n\x00")
    assert shared.state().tick == before + 1
    shared.serial.write(b"\x55" * 5000 + b"\x00\x00")  # too long to be a frame, and an empty one
    damaged = bytearray(encode_frame(SetMotor(5), 9))
    damaged[5] ^= 0x40
    shared.serial.write(bytes(damaged))
    assert shared.state().tick == before + 2
    assert tick(shared) == before + 3


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_host_may_close_the_port_and_come_back_and_a_signal_ends_it_quietly(clock):
    with emulator(clock=clock) as host:
        for _ in range(3):
            before = tick(host)
            host.serial.close()
            host.open()
            assert tick(host) > before
        host.process.send_signal(signal.SIGINT)  # SIGTERM ends every other one here
        assert host.process.wait(SILENCE) == 0


def test_no_state_is_lost_on_a_host_that_reads_slowly(shared):
    before = tick(shared)
    for _ in range(OVERFULL):
        shared.send(Hello())
    time.sleep(1.0)  # the line is full by then
    assert states_of(shared, OVERFULL)[-1].tick == before + OVERFULL


def test_real_clock_ticks_at_50_hz():
    with emulator(clock="real") as host:
        first, started = host.state(), time.monotonic()
        states = states_of(host, 60)
        seconds = time.monotonic() - started
    assert [state.tick - first.tick for state in states] == list(range(1, 61))
    periods = [after.time_us - before.time_us for before, after in itertools.pairwise(states)]
    assert statistics.median(periods) == 20_000
    assert min(periods) >= 20_000  # longer ones on a busy machine
    assert 0.6 < seconds < 2.4


def test_a_signal_ends_it_even_while_it_waits_for_its_host_to_read():
    with emulator() as host:
        for _ in range(OVERFULL):
            host.send(Hello())
        time.sleep(1.0)  # their answers fill the line
        host.process.terminate()
        assert host.process.wait(SILENCE) == 0


def until_unplugged(host: EmulatorHost) -> list[State]:
    """Return the states that arrive before the cable is pulled."""
    states = []
    try:
        while True:
            states.append(host.ask(Hello())[-1].message)
    except OSError:  # pyserial's own is one
        return states


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_pulled_cable_ends_the_line_and_the_process(clock):
    with emulator(clock=clock, unplug_at=0.3) as host:
        states = until_unplugged(host)
        assert host.process.wait(SILENCE) == 0
    assert max((state.time_us for state in states), default=0) < 300_000
    if clock == "lockstep":
        assert len(states) == 14


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_reset_is_a_boot(clock):
    with emulator(clock=clock, reset_at=1.5) as host:
        ticks = [tick(host)]
        while len(ticks) < 2 or ticks[-1] > ticks[-2]:
            ticks.append(tick(host))
            assert ticks[-1] <= 75
        after = host.ask(Hello())[-1].message
    assert after.time_us == 20_000 * after.tick
    assert after.command_age_ms == 65535
    assert host.came.count(BANNER) == 2
    if clock == "lockstep":
        assert ticks == [*range(1, 76), 1]


def test_a_booted_board_prints_text_and_the_host_is_in_step_after_it():
    assert BANNER.endswith(b"\n\x00")
    assert BANNER.count(0) == 1
    assert len(BANNER) > LONGEST_FRAME  # longer than a reader collects
    with EmulatedCart(EmulatorSettings(**COARSE)) as emulated:
        raw = serial.Serial(emulated.port, timeout=SILENCE)
        assert raw.read(len(BANNER)) == BANNER
        raw.close()
    with EmulatedCart(EmulatorSettings(**COARSE)) as emulated:
        for _ in range(2):  # the board prints once and keeps running
            with SerialCart(emulated.settings) as cart:
                ticks = [cart.poll_state().tick for _ in range(5)]
                assert ticks == list(range(ticks[0], ticks[0] + 5))
                assert cart.statistics.summary()["bad_frames"] == 0


def refusal(*command: str) -> tuple[int, str]:
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=SILENCE)
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    return done.returncode, done.stderr


def test_wrong_settings_are_reported_in_one_line():
    status, message = refusal("-m", "cartpole_rl.emulator", '{"cart_mass": -1, "colour": "red"}')
    assert status == 2
    assert "cart_mass: Input should be greater than or equal to 0.000001" in message
    with pytest.raises(ConfigError, match=r"^emulator settings: settings: Invalid JSON"):
        read_settings("cart_mass=1")


def test_without_mujoco_the_remedy_is_printed_in_one_line():
    hide = "import sys, runpy; sys.modules['mujoco'] = None; sys.argv = ['emulator']; "
    status, message = refusal("-c", hide + "runpy.run_module('cartpole_rl.emulator', run_name='__main__')")
    assert status == 1
    assert 'pip install "cartpole_rl[emulator]"' in message


def test_it_starts_without_torch_and_without_the_simulator():
    code = """
import sys
import cartpole_rl.emulator.__main__
from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.emulator.settings import EmulatorSettings
CartDevice(EmulatorSettings())
print(sorted(name for name in sys.modules if name.split(".")[0] in ("torch", "tensordict", "torchrl", "scipy")
      or name.startswith(("cartpole_rl.physics", "cartpole_rl.tasks", "cartpole_rl.randomization"))))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=SILENCE)
    assert done.stdout == "[]\n", done.stderr
