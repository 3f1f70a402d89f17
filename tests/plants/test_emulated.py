"""The emulated cart as a process and as a plant: pyserial, a pseudo-terminal, lockstep."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial

import pytest
import torch
from tensordict import TensorDict

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.errors import ConfigError, EmulatorError, LinkError
from cartpole_rl.plants.emulated import EmulatedCart
from cartpole_rl.plants.serial.errors import RefusedError
from cartpole_rl.plants.serial.plant import SerialPlant, emulated_plant
from cartpole_rl.plants.settings import EmulatedSettings
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.signals import PARENT

TURN = 4096

fast = partial(EmulatorSettings, physics_step=1e-3)


@pytest.fixture(scope="module")
def plant() -> Iterator[SerialPlant]:
    with contextlib.closing(emulated_plant(fast())) as plant:
        yield plant


def push(plant: SerialPlant, motor: int) -> TensorDict:
    return plant.step(TensorDict({"motor": torch.full((1, 1), motor)}, [1]))["next"]


def test_an_episode_begins_in_the_middle_with_a_hanging_pole(plant: SerialPlant) -> None:
    cart, pole = plant.reset()["counts"][0].tolist()
    assert abs(cart) < 100
    assert abs(pole % TURN - TURN // 2) < 10


@pytest.mark.parametrize("side", [1, -1])
def test_the_end_of_the_track_ends_the_episode_and_the_next_one_begins(plant: SerialPlant, side: int) -> None:
    plant.reset()
    for _ in range(200):
        frame = push(plant, side * 250)
        if frame["done"]:
            break
    assert frame["terminated"]
    assert not frame["truncated"]
    assert plant.ended_by == "track"
    assert side * frame["counts"][0, 0] >= plant.cart.information.soft_limit_counts
    assert side * plant.cart.poll_state().motor_applied <= 0  # the firmware brakes
    before_us = plant.cart.poll_state().time_us
    frame = plant.reset()
    assert plant.cart.poll_state().time_us - before_us < 20e6  # its brake lost no counts: it need not home
    assert not frame["done"]
    assert abs(frame["counts"][0, 0]) < 100
    assert abs(frame["counts"][0, 1] % TURN - TURN // 2) < 16


def test_an_upright_start() -> None:
    said: list[str] = []
    settings = fast(start="upright")
    with contextlib.closing(emulated_plant(settings, prompt=said.append)) as plant:
        for episode in (1, 2):
            pole = plant.reset()["counts"][0, 1].item()
            assert abs((pole + TURN // 2) % TURN - TURN // 2) < 60
            assert len(said) == episode
            falling = [push(plant, 0)["counts"][0, 1].item() for _ in range(60)]
            assert abs(falling[-1] - pole) > 300


def test_a_killed_emulator_truncates_and_the_next_reset_says_so() -> None:
    emulated = EmulatedCart(fast())
    with contextlib.closing(SerialPlant(emulated.settings, owned=emulated)) as plant:
        plant.reset()
        before = push(plant, 100)
        os.kill(emulated.pid, signal.SIGKILL)
        time.sleep(0.2)
        frame = push(plant, 100)
        assert frame["truncated"]
        assert not frame["terminated"]
        assert frame["counts"].equal(before["counts"])
        assert plant.ended_by == "link"
        assert isinstance(plant.last_error, LinkError)
        with (
            contextlib.closing(EmulatedCart(fast())),  # its port may be that of the other one
            pytest.raises(LinkError, match=r"link to the cart was lost .*exit code -9"),
        ):
            plant.reset()


def test_pole_length_is_that_of_the_emulated_pole(plant: SerialPlant) -> None:
    assert plant.pole_length.tolist() == pytest.approx([2 * EmulatorSettings().pole_com])


def test_two_hundred_periods_pass_without_a_loss(plant: SerialPlant) -> None:
    plant.reset()
    cart = plant.cart
    cart.statistics.clear()
    first = cart.get_state()
    for _ in range(200):
        cart.set_motor(0)
        last = cart.get_state()
    assert last.tick == first.tick + 200
    assert last.time_us - first.time_us == 200 * 20_000
    summary = cart.statistics.summary()
    assert [summary[name] for name in ("bad_frames", "lost_frames", "late_ticks")] == [0, 0, 0]
    assert summary["latency_samples"] == 200


def test_an_armed_cart_does_not_take_another_period(plant: SerialPlant) -> None:
    plant.reset()
    cart = plant.cart
    cart.statistics.clear()
    with pytest.raises(RefusedError, match=r"refused SET_PERIOD: .*stop it first"):
        cart.set_period(10_000)
    with pytest.raises(RefusedError, match="out of range"):
        cart.stop() or cart.set_period(1)


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
