"""The driving process on a scripted cart: confirmation and exit."""

import fcntl
import os
import signal
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from serial_peer import CartPeer, wait_for
from torch import nn

from cartpole_rl.agents.settings import AgentSettings
from cartpole_rl.choices import choice
from cartpole_rl.envs.build import make_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import ObservationSettings
from cartpole_rl.errors import FaultError, LinkError
from cartpole_rl.evaluation.driver import Driver, EpisodeRequest
from cartpole_rl.evaluation.driving_policy import as_weights
from cartpole_rl.learning.agent import QAgent
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.serial.preparation import Confirm
from cartpole_rl.plants.serial.tracking import LATENCY_SAMPLES
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.tasks.settings import ActionSettings, RewardSettings, TaskSettings
from cartpole_rl.wire.messages import ClearFault, Fault, Message, SetMotor, Stop

LONG = 100_000  # periods
HEADER = 4  # bytes before a message in a pipe


def scripted_env(port: str, confirm: Confirm, time_limit: int = LONG) -> CartPoleEnv:
    """Made in the driving process."""
    plant = SerialPlant(SerialSettings(port=port), confirm=confirm)
    plant.statistics.latency.extend([0.0] * LATENCY_SAMPLES)  # of a long run
    task = choice("task/swingup") | {"x_max": 0.38, "time_limit": time_limit}
    return make_env(
        plant,
        ActionSettings(**choice("actions/two")),
        TaskSettings(**task),
        ObservationSettings(**choice("observation/history")),
        RewardSettings(**choice("reward/score")),
    )


def network() -> nn.Module:
    """An untrained one, the same each time."""
    print("made")
    torch.manual_seed(0)
    observation = ObservationSettings(**choice("observation/history"))
    return QAgent(AgentSettings(**choice("agent/dqn")).at(0.02), observation.mirror_signs, 2).greedy_policy()


def logging(log: Path) -> nn.Module:
    """A policy that never closes its log, which Python writes at the end of the process."""
    policy = network()
    policy.log = log.open("w")  # type: ignore[assignment]
    policy.log.write("made")
    return policy


class Faulty(CartPeer):
    """Has a latched fault until it is cleared."""

    def __init__(self) -> None:
        super().__init__()
        self.state = replace(self.state, fault=int(Fault.STALL))

    def carry_out(self, message: Message) -> None:
        if isinstance(message, ClearFault):
            self.state = replace(self.state, fault=0)
        super().carry_out(message)


@pytest.fixture
def peer() -> Iterator[Faulty]:
    with Faulty() as peer:
        yield peer


def driver(
    peer: CartPeer, confirm: Confirm, time_limit: int = LONG, policy: Callable[[], nn.Module] = network
) -> Driver:
    return Driver(partial(scripted_env, peer.port, time_limit=time_limit), policy, False, confirm)


def test_a_person_who_declines_is_an_error(peer: Faulty, capfd: pytest.CaptureFixture[str]) -> None:
    with driver(peer, lambda text: False) as driving:
        driving.start(EpisodeRequest(as_weights(network()), 0.0, 0))
        with pytest.raises(FaultError, match=r"the motor was driven but the cart did not move.*confirm"):
            driving.result()
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT])
def test_a_hangup_and_ctrl_c_stop_the_motor(
    number: signal.Signals, peer: Faulty, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A person confirms; then the terminal signals the process that drives the cart, too."""
    asked = []

    def confirm(text: str) -> bool:
        asked.append(text)
        threading.Thread(target=end).start()
        return True

    def end() -> None:
        deadline = time.monotonic() + 60
        while not any(message.motor for message in peer.messages(SetMotor)):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(driving.pid, number)

    with driver(peer, confirm, policy=partial(logging, tmp_path / "log")) as driving:
        driving.start(EpisodeRequest(as_weights(network()), 0.0, 0))
        with pytest.raises(LinkError, match="has died"):
            driving.result()
    assert len(asked) == 1
    printed, complained = capfd.readouterr()
    assert (printed, "Traceback" in complained) == (2 * "made\n", False)  # here, and in the process
    assert (tmp_path / "log").read_text() == "made"
    assert [type(frame.message) for frame in peer.received[-2:]] == [SetMotor, Stop]
    assert peer.state.motor_applied == 0


def unread(driving: Driver) -> int:
    """Bytes that have arrived."""
    waiting: bytes = fcntl.ioctl(driving._ours.fileno(), termios.FIONREAD, bytes(4))
    return int.from_bytes(waiting, sys.byteorder)


def test_a_process_that_is_killed_while_it_sends_an_episode_has_died() -> None:
    """A pipe does not take a whole episode at once, and this process may read it much later."""
    with CartPeer() as peer, driver(peer, lambda text: False, time_limit=2) as driving:
        driving.start(EpisodeRequest(as_weights(network()), 0.0, 0))
        wait_for(lambda: unread(driving) > HEADER)
        os.kill(driving.pid, signal.SIGKILL)
        driving._process.join()  # else its write goes on for as long as this process reads
        with pytest.raises(LinkError, match="has died"):
            driving.result()
