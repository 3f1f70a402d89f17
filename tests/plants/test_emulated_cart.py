"""The host's code on the emulated cart: pyserial, a pseudo-terminal, a process, lockstep."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial

import pytest
from emulator_host import drive_and_fail

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import EmulatorError, LinkError
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import RefusedError
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.wire import Flags, Reason

fast = partial(EmulatorSettings, physics_step=1e-3)


@pytest.fixture(scope="module")
def homed() -> Iterator[SerialCart]:
    """A homed and disarmed cart; every test restores this state."""
    with EmulatedCart(fast()) as emulated, SerialCart(settings(emulated)) as cart:
        cart.home()
        yield cart


@pytest.fixture
def cart(homed: SerialCart) -> Iterator[SerialCart]:
    homed.statistics.clear()
    yield homed
    homed.stop()
    for _ in range(100):  # until it has rolled out
        homed.poll_state()


def settings(emulated: EmulatedCart) -> SerialSettings:
    return SerialSettings(port=emulated.port, timeout=5, nudge_after=2, answer_timeout=2)


def ended(pid: int, seconds: float = 10.0) -> bool:
    """Return True if the process ends within `seconds`."""
    for _ in range(int(seconds / 0.05)):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


class TestProcess:
    def test_it_runs_within_the_with(self) -> None:
        with EmulatedCart(fast()) as emulated:
            os.kill(emulated.pid, 0)
            assert emulated.died == ""
        assert ended(emulated.pid)

    def test_an_early_death_is_an_error(self) -> None:
        with pytest.raises(EmulatorError, match="exit code -9"), EmulatedCart(fast()) as emulated:
            kill(emulated)

    def test_an_early_death_does_not_hide_another_error(self) -> None:
        with pytest.raises(ValueError, match="mine"), EmulatedCart(fast()) as emulated:
            kill(emulated, ValueError("mine"))

    def test_a_process_that_cannot_start_reports_the_reason(self) -> None:
        wrong = EmulatorSettings.model_construct(cart_mass=-1.0)
        with pytest.raises(EmulatorError, match=r"exit code 2: .*cart_mass"):
            EmulatedCart(wrong)

    def test_it_ends_when_the_host_dies(self) -> None:
        program = (
            "from cartpole_rl.plants.emulated import EmulatedCart\n"
            "from cartpole_rl.emulator.settings import EmulatorSettings\n"
            "import os\n"
            "print(EmulatedCart(EmulatorSettings()).pid, flush=True)\n"
            "os.kill(os.getpid(), 9)\n"
        )
        host = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=False)
        assert host.returncode == -signal.SIGKILL
        assert ended(int(host.stdout))


class TestLoop:
    def test_two_hundred_periods_pass_without_a_loss(self, cart: SerialCart) -> None:
        cart.start()
        first = cart.get_state()
        for _ in range(200):
            cart.set_motor(0)
            last = cart.get_state()
        assert last.tick == first.tick + 200
        assert last.time_us - first.time_us == 200 * 20_000
        summary = cart.statistics.summary()
        assert (summary.bad_frames, summary.lost_frames, summary.late_ticks) == (0, 0, 0)
        assert summary.latency_samples == 200

    @pytest.mark.parametrize("side", [1, -1])
    def test_the_cart_goes_where_the_motor_pushes(self, cart: SerialCart, side: int) -> None:
        cart.start()
        first = cart.get_state()
        for _ in range(15):
            cart.set_motor(side * 150)
            last = cart.get_state()
        assert side * (last.cart_counts - first.cart_counts) > 500
        assert (
            side * (last.pole_counts - first.pole_counts) > 10
        )  # a hanging pole lags, its tip to the other side

    def test_the_motor_value_is_saturated_and_reported(self, cart: SerialCart) -> None:
        cart.start()
        assert cart.set_motor(1000) == 255
        assert cart.get_state().motor_applied == 255
        assert cart.set_motor(-1000) == -255
        assert cart.get_state().motor_applied == -255

    def test_an_unarmed_cart_refuses_a_motor_value(self, cart: SerialCart) -> None:
        cart.set_motor(100)
        with pytest.raises(RefusedError, match="refused SET_MOTOR: its motor is not armed") as caught:
            cart.get_state()
        assert caught.value.reason == Reason.NOT_ARMED
        assert cart.poll_state().motor_applied == 0

    def test_an_armed_cart_does_not_take_another_period(self, cart: SerialCart) -> None:
        cart.start()
        with pytest.raises(RefusedError, match=r"refused SET_PERIOD: .*stop it first"):
            cart.set_period(10_000)
        with pytest.raises(RefusedError, match="out of range"):
            cart.stop() or cart.set_period(1)

    def test_states_from_questions_are_read_in_order(self, cart: SerialCart) -> None:
        ticks = [cart.poll_state().tick for _ in range(5)]
        assert ticks == list(range(ticks[0], ticks[0] + 5))
        cart.start()
        assert cart.get_state().tick == ticks[-1] + 1


def test_a_cart_that_is_not_homed_does_not_start() -> None:
    with EmulatedCart(fast()) as emulated, SerialCart(settings(emulated)) as cart:
        with pytest.raises(RefusedError, match="START: it is not homed"):
            cart.start()
        assert not cart.flags & Flags.HOMED


def test_an_error_inside_with_leaves_a_cart_with_motor_0() -> None:
    with EmulatedCart(fast()) as emulated:
        with pytest.raises(ZeroDivisionError), SerialCart(settings(emulated)) as cart:
            drive_and_fail(cart)
        with SerialCart(settings(emulated)) as cart:
            state = cart.get_state()
            assert state.motor_applied == 0
            assert not cart.flags & Flags.ARMED
            assert cart.flags & Flags.HOMED


def test_a_bad_cable_only_loses_frames() -> None:
    bad = fast(frame_loss=0.05, frame_corruption=0.05)
    with EmulatedCart(bad) as emulated:
        quick = SerialSettings(port=emulated.port, timeout=5, answer_timeout=0.1, retries=20)
        with SerialCart(quick) as cart:
            cart.home()
            cart.start()
            first = cart.get_state().tick
            cart.statistics.clear()
            ticks = []
            for period in range(500):
                cart.set_motor(60 if period % 20 < 10 else -60)
                ticks.append(cart.get_state().tick)
            summary = cart.statistics.summary()
    assert all(late > early for early, late in zip([first, *ticks], ticks, strict=False))
    assert 10 < summary.bad_frames < 60  # 5 % of 500 each way, only the way to the host is seen
    assert 20 < summary.lost_frames < 110
    assert ticks[-1] - first == summary.frames_received + summary.lost_frames


def test_a_dead_emulator_is_a_lost_link() -> None:
    with (
        contextlib.closing(EmulatedCart(fast())) as emulated,
        SerialCart(settings(emulated)) as cart,
    ):
        kill(emulated)
        with pytest.raises(LinkError, match="unplugged"):
            cart.poll_state()


def test_after_a_pause_the_newest_state_is_returned() -> None:
    with EmulatedCart(fast(clock="real")) as emulated, SerialCart(settings(emulated)) as cart:
        before = cart.get_state()
        time.sleep(1.0)
        after = cart.get_state()
        assert after.time_us - before.time_us >= 950_000
        assert cart.get_state().tick == after.tick + 1


def kill(emulated: EmulatedCart, error: Exception | None = None) -> None:
    """Kill the process, wait until it is gone, and raise `error`."""
    os.kill(emulated.pid, signal.SIGKILL)
    while not emulated.died:
        time.sleep(0.02)
    if error is not None:
        raise error
