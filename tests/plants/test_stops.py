"""After every kind of end of a host, the motor is soon at 0, according to the emulated cart's journal.

The cart runs on the wall clock and writes down, by its own clock, which commands it took and which motor
value was in force from when on. It homes at once, and is too heavy for full motor to take it off the track.
"""

import itertools
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import torch
from serial_peer import Between
from tensordict import TensorDictBase

from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.identification.experiments import Experiment, Moves, Task, conduct, hold
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.wire.messages import Flags

PERIOD_MS = 20
WATCHDOG_MS = 3 * PERIOD_MS
FULL = 255
MOST_PUSHES = 20
QUIET = 0.3  # s without a word from the cart: whoever drove it does no more

EMULATOR = """
import math, sys
from pathlib import Path
from cartpole_rl.emulator import device, firmware
from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.emulator.homing import Zeros
from cartpole_rl.emulator.settings import EmulatorSettings

class HomingAtOnce:
    def __init__(self, hardware):
        self.half = hardware.encoders.cart_counts(hardware.half_span)

    def home(self):
        reading = yield 0
        return Zeros(reading.cart - self.half, reading.cart + self.half, reading.pole)

class Centred(CartDevice):
    "Stands in the middle when it homes."

    def receive(self, stuffed, now_us):
        answer = super().receive(stuffed, now_us)
        if self.firmware.homing:
            self.physics.place(0.0, math.pi)
        return answer

firmware.Homing = HomingAtOnce
device.CartDevice = Centred
journal = Path(sys.argv[1])
device.run(EmulatorSettings(clock="real", cart_mass=20.0, physics_step=1e-3, journal=journal))
"""

HOST = """
import itertools, signal, sys
from contextlib import suppress
from cartpole_rl.errors import LinkError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.settings import SerialSettings

from cartpole_rl.signals import ending_signals

class Terminated(BaseException):
    "What the commands of this package make of SIGTERM and SIGHUP."

def terminate(number, frame):
    raise Terminated

if sys.argv[2] == "unwinds":
    for ending in ending_signals():
        signal.signal(ending, terminate)
with SerialCart(SerialSettings(port=sys.argv[1])) as cart:
    cart.home()
    cart.start()
    for period in itertools.count():
        with suppress(LinkError):  # on a busy machine a motor value came too late, and was refused
            cart.get_state()
        cart.set_motor(255)
        if period == 3:
            print("driving", flush=True)
"""


class TellingCart:
    """The emulated cart, and its journal since `listen`."""

    def __init__(self, journal: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", EMULATOR, str(journal)], stdout=subprocess.PIPE
        )
        assert self.process.stdout is not None
        self.port = json.loads(self.process.stdout.readline())["port"]
        self._told = journal.open("rb")
        self.listen()

    def listen(self) -> None:
        """Ignore journal entries so far."""
        self._from = self._told.seek(0, 2)

    def told(self) -> list[dict[str, Any]]:
        self._told.seek(self._from)
        *lines, _ = self._told.read().split(b"\n")
        return [json.loads(line) for line in lines]

    def check_stopped(self, *by: str) -> None:
        """Check that after full motor the motor is soon at 0 and stays there, and by what: STOP or watchdog.

        A host on a busy machine may pause for longer than the watchdog allows, and then drive again.
        """
        end = time.monotonic() + 10
        before: list[dict[str, Any]] = []
        while time.monotonic() < end:
            told = self.told()
            full = [line["us"] for line in told if line.get("in_force") == FULL]
            zero = [line["us"] for line in told if line.get("in_force") == 0]
            if full and zero and zero[-1] > full[-1] and told == before:
                commands = [line["us"] for line in told if line.get("motor") == FULL]
                stops = [line["us"] for line in told if line.get("took") == "STOP" and line["us"] > full[0]]
                assert 0 < (zero[-1] - commands[-1]) / 1000 <= WATCHDOG_MS
                assert ("STOP" if stops else "watchdog") in by
                return
            before = told
            time.sleep(QUIET)
        raise AssertionError(f"the motor does not stay at 0: {self.told()}")

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(100)
        assert self.process.stdout is not None
        self.process.stdout.close()
        self._told.close()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TellingCart]:
    with closing(TellingCart(tmp_path_factory.mktemp("cart") / "journal.jsonl")) as cart:
        yield cart


@pytest.fixture
def cart(running: TellingCart) -> TellingCart:
    running.listen()
    return running


@pytest.fixture
def host() -> Iterator[Callable[..., "subprocess.Popen[bytes]"]]:
    """Starts a program that drives with full motor; it drives when it is returned."""
    started: list[subprocess.Popen[bytes]] = []

    def start(port: str, manner: str = "plain") -> "subprocess.Popen[bytes]":
        process = subprocess.Popen(
            [sys.executable, "-c", HOST, port, manner], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == b"driving\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    ("ending", "manner", "by"),
    [
        (signal.SIGKILL, "plain", "watchdog"),
        (signal.SIGSTOP, "plain", "watchdog"),
        (signal.SIGTERM, "unwinds", "STOP"),
        (signal.SIGINT, "plain", "STOP"),
    ],
)
def test_a_signal_after_which_the_cart_can_be_driven_again(
    cart: TellingCart,
    host: Callable[..., "subprocess.Popen[bytes]"],
    ending: signal.Signals,
    manner: str,
    by: str,
) -> None:
    process = host(cart.port, manner)
    process.send_signal(ending)
    cart.check_stopped(by)
    process.kill()
    process.wait()
    with SerialCart(SerialSettings(port=cart.port)) as again:
        assert again.get_state().motor_applied == 0
        assert again.flags & (Flags.ARMED | Flags.HOMED) == Flags.HOMED


def test_a_pulled_cable(cart: TellingCart, host: Callable[..., "subprocess.Popen[bytes]"]) -> None:
    with Between(cart.port) as cable:
        process = host(cable.port)
        cable.cut()
        cart.check_stopped("watchdog")
        _, said = process.communicate(timeout=100)
        assert b"is the cart unplugged" in said


def always_right(seen: TensorDictBase) -> TensorDictBase:
    return seen.set("action", torch.full(seen.batch_size, 2))


def serial_plant(cart: TellingCart) -> SerialPlant:
    return SerialPlant(SerialSettings(port=cart.port))


def test_an_exception_in_the_policy(cart: TellingCart, make_environment: Callable) -> None:
    decided = itertools.count(1)

    def fails(seen: TensorDictBase) -> TensorDictBase:
        if next(decided) == 6:
            raise ZeroDivisionError
        return always_right(seen)

    with (
        pytest.raises(ZeroDivisionError),
        closing(make_environment(serial_plant(cart), motors=(-FULL, 0, FULL))) as env,
    ):
        run_batch(env, fails)
    cart.check_stopped("STOP")


def test_an_action_value_that_is_not_a_number(cart: TellingCart, make_environment: Callable) -> None:
    decided = itertools.count(1)

    def diverges(seen: TensorDictBase) -> TensorDictBase:
        value = torch.full((1, 3), 0.0 if next(decided) < 6 else float("nan"))
        return always_right(seen).set("action_value", value)

    with closing(make_environment(serial_plant(cart), motors=(-FULL, 0, FULL))) as env:
        (episode,) = run_batch(env, diverges)
        assert episode.ended_by == "non_finite"
        assert episode.motor.tolist() == [FULL] * 5 + [0]
        cart.check_stopped("STOP")  # though the port is still open


def test_an_experiment_of_the_identification(cart: TellingCart) -> None:
    """The motor is at 0 by the host's own command before a recording is written, however long that takes."""

    def push(task: Task) -> Moves:
        yield from hold(FULL, 0.1, task)
        return None

    experiments = tuple(Experiment(f"number {number}", "nothing", push) for number in range(MOST_PUSHES))
    with closing(serial_plant(cart)) as plant:
        looked_at = 0
        for _, episode in conduct(plant, PERIOD_MS / 1000, experiments=experiments):
            if episode.ended_by == "link":  # a busy machine suspended the host, and a value came too late
                cart.listen()
                continue
            cart.check_stopped("STOP", "watchdog")
            commands = [line["motor"] for line in cart.told() if line.get("took") == "SET_MOTOR"]
            assert commands[-1] == 0
            assert episode.motor[-1] == 0
            cart.listen()
            looked_at += 1
            if looked_at == 2:
                return
    raise AssertionError("no push was done")


def test_the_end_of_an_episode(cart: TellingCart, make_environment: Callable) -> None:
    with closing(make_environment(serial_plant(cart), motors=(-FULL, 0, FULL), time_limit=6)) as env:
        (episode,) = run_batch(env, always_right)
        assert episode.ended_by == "time"
        cart.check_stopped("STOP")  # though the port is still open
