"""The emulated cart as a process: what starts it, ends it and is said of its death."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError, EmulatorError, LinkError
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.settings import EmulatedSettings
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.signals import PARENT

fast = partial(EmulatorSettings, physics_step=1e-3)


def test_a_killed_emulator_truncates_and_the_next_reset_says_so() -> None:
    emulated = EmulatedCart(fast())
    with contextlib.closing(SerialPlant(emulated.settings, owned=emulated)) as plant:
        plant.reset()
        before = plant.step_one(100)
        os.kill(emulated.pid, signal.SIGKILL)
        time.sleep(0.2)
        frame = plant.step_one(100)
        assert (frame.terminated, frame.truncated) == ((False,), (True,))
        assert frame.counts == before.counts
        assert plant.ended_by == "link"
        assert isinstance(plant.last_error, LinkError)
        with (
            contextlib.closing(EmulatedCart(fast())),  # its port may be that of the other one
            pytest.raises(LinkError, match=r"link to the cart was lost .*exit code -9"),
        ):
            plant.reset()


def ended(pid: int) -> bool:
    """Return True if the process ends within ten seconds."""
    for _ in range(200):
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

    def test_it_ends_if_the_host_died_while_it_started(self) -> None:
        """Its parent is another process then, from the start."""
        gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], stdout=subprocess.PIPE)
        cart = subprocess.run(
            [sys.executable, "-m", "cartpole_rl.emulator"],
            env={**os.environ, PARENT: gone.stdout.decode().strip()},
            timeout=60,
            check=False,
        )
        assert cart.returncode in (0, -signal.SIGTERM)  # its own handler, or none yet


def kill(emulated: EmulatedCart, error: Exception | None = None) -> None:
    """Kill the process, wait until it is gone, and raise `error`."""
    os.kill(emulated.pid, signal.SIGKILL)
    while not emulated.died:
        time.sleep(0.02)
    if error is not None:
        raise error


def test_a_start_that_would_be_replaced_is_refused() -> None:
    chosen = EmulatedSettings(kind="emulated").reachable(fast(start="upright"), nominal_hardware())
    with pytest.raises(ConfigError, match="start=upright: this cart starts hanging"), chosen:
        pass
