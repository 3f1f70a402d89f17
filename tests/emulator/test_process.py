"""The emulator as its own process, over its real pseudo-terminal, spoken to with pyserial."""

import itertools
import signal
import statistics
import subprocess
import sys
import time

import pytest

pytest.importorskip("mujoco", reason='pip install "cartpole_rl[emulator]"')

from emulator_host import SILENCE, EmulatorHost, emulator

from cartpole_rl.wire import (
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
    encode_frame,
)

COARSE = {"physics_step": 1e-3}

OVERFULL = 100  # frames, whose answers fill the line


def states_of(host: EmulatorHost, count: int) -> list[State]:
    return [host.state() for _ in range(count)]


def drive(**settings: object) -> bytes:
    """All bytes that came while a cart was homed, driven and stopped."""
    with emulator(**COARSE | settings) as host:
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


def test_lockstep_repeats_byte_for_byte_and_the_seed_matters():
    first = drive(seed=3, frame_loss=0.05, frame_corruption=0.05)
    assert drive(seed=3, frame_loss=0.05, frame_corruption=0.05) == first
    assert drive(seed=4, frame_loss=0.05, frame_corruption=0.05) != first


def test_nothing_passes_by_itself_in_lockstep():
    with emulator() as host:
        host.ask(Hello())
        host.serial.timeout = 0.3
        assert host.serial.read(1) == b""
        host.serial.timeout = SILENCE
        assert host.ask(Hello())[-1].message.tick == 2


def test_one_undamaged_state_comes_for_each_frame_however_bad_the_cable():
    with emulator(frame_loss=0.3, frame_corruption=0.3) as host:
        ticks = [host.ask(Hello())[-1].message.tick for _ in range(200)]
    assert host.damaged > 20
    gaps = [after - before for before, after in itertools.pairwise(ticks)]
    assert min(gaps) == 1
    assert sum(gap > 1 for gap in gaps) > 50  # the cart ticked on while its states were lost


def test_garbage_passes_a_period_and_does_no_harm():
    with emulator() as host:
        host.ask(Hello())
        host.serial.write(b"ets Jul 29 2019 12:21:46\r\n\x00")
        assert host.state().tick == 2
        host.serial.write(b"\x55" * 5000 + b"\x00\x00")  # too long to be a frame, and an empty one
        damaged = bytearray(encode_frame(SetMotor(5), 9))
        damaged[5] ^= 0x40
        host.serial.write(bytes(damaged))
        assert host.state().tick == 3
        assert host.ask(Hello())[-1].message.tick == 4


@pytest.mark.parametrize("clock", ["lockstep", "real"])
def test_a_host_may_close_the_port_and_come_back(clock):
    with emulator(clock=clock) as host:
        for _ in range(3):
            before = host.ask(Hello())[-1].message
            host.serial.close()
            host.open()
            assert host.ask(Hello())[-1].message.tick > before.tick


def test_no_state_is_lost_on_a_host_that_reads_slowly():
    with emulator(**COARSE) as host:
        for _ in range(OVERFULL):
            host.send(Hello())
        time.sleep(1.0)  # the line is full by then
        ticks = [host.state().tick for _ in range(OVERFULL)]
    assert ticks == list(range(1, OVERFULL + 1))


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


@pytest.mark.parametrize(("clock", "number"), [("lockstep", signal.SIGINT), ("real", signal.SIGTERM)])
def test_signals_end_it_quietly(clock, number):
    with emulator(clock=clock) as host:
        host.ask(Hello())
        host.process.send_signal(number)
        assert host.process.wait(SILENCE) == 0


def test_a_signal_ends_it_even_while_it_waits_for_its_host_to_read():
    with emulator() as host:
        for _ in range(OVERFULL):
            host.send(Hello())
        time.sleep(1.0)  # their answers fill the line
        host.process.terminate()
        assert host.process.wait(SILENCE) == 0


def refusal(*command: str) -> tuple[int, str]:
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True, timeout=SILENCE)
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ('{"cart_mass": -1, "colour": "red"}', "cart_mass: Input should be greater than 0"),
        ("cart_mass=1", "Invalid JSON"),
    ],
)
def test_wrong_settings_are_reported_in_one_line(settings, complaint):
    status, message = refusal("-m", "cartpole_rl.emulator", settings)
    assert status == 2
    assert complaint in message


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
