"""Driving a cart in a separate process, so that learning, plotting or writing cannot delay a tick.

The process waits for the weights of a policy, runs one episode, and sends it back. It ends with its parent,
even during an episode, and every exit sets the motor to 0 and disarms the cart.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import CartPoleError, LinkError
from cartpole_rl.evaluation.driving_policy import DrivingPolicy, Weights
from cartpole_rl.evaluation.episodes import run_batch, warm_up
from cartpole_rl.plants.serial.preparation import Confirm, nobody
from cartpole_rl.plants.serial.tracking import LinkStatistics
from cartpole_rl.scheduling import ImportedFast, take_precedence
from cartpole_rl.signals import UNWINDING, RaiseOnce, end_with_parent, ending_signals
from cartpole_rl.tasks.episode import Episode

GRACE = UNWINDING + 4.0  # s from SIGTERM to SIGKILL: after the unwinding, PyTorch takes seconds to end
Result = tuple[Episode, LinkStatistics]  # the link since the process started
MakeEnv = Callable[[Confirm], CartPoleEnv]  # over a cart whose faults are cleared if a person confirms


@dataclass(frozen=True)
class EpisodeRequest:
    """A request to drive one episode."""

    weights: Weights  # of the greedy policy
    epsilon: float  # share of random actions
    seed: int


class Driver:
    """A context manager of a process that drives the cart of `make_env` with the network of `make_policy`.

    The process calls both. `confirm` is called in this process, which has the terminal, while it waits for a
    result. For a cart with its own clock, `real_time`, the process asks for real-time priority;
    `has_priority` says if it got it. Raises the errors of `make_env`.
    """

    def __init__(
        self,
        make_env: MakeEnv,
        make_policy: Callable[[], nn.Module],
        real_time: bool,
        confirm: Confirm = nobody,
    ) -> None:
        self._confirm = confirm
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(
            target=ImportedFast(_serve),
            args=(theirs, make_env, make_policy, real_time, os.getpid()),
            daemon=True,
        )
        self._process.start()
        theirs.close()
        try:
            self.has_priority: bool = self._receive()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """The process id."""
        assert self._process.pid is not None
        return self._process.pid

    def start(self, drive: EpisodeRequest) -> None:
        """Start an episode, and return at once. Raises LinkError if the process died."""
        with _alive():
            self._ours.send(drive)

    def result(self) -> Result:
        """Wait for the started episode. Raises the errors of its reset, or LinkError if the process died."""
        driven: Result = self._receive()
        return driven

    def close(self) -> None:
        """Set the motor to 0, disarm, end the process."""
        self._process.terminate()
        self._process.join(GRACE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._ours.close()

    def __enter__(self) -> "Driver":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self) -> Any:
        with _alive():
            answer = self._ours.recv()
        while isinstance(answer, str):  # a fault, to be cleared if a person confirms it
            agreed = self._confirm(answer)
            with _alive():
                self._ours.send(agreed)
                answer = self._ours.recv()
        if isinstance(answer, BaseException):
            raise answer
        return answer


@contextmanager
def _alive() -> Iterator[None]:
    """Raise LinkError if the other end of the pipe is closed, also in the middle of a message."""
    try:
        yield
    except (EOFError, OSError):
        raise LinkError("the process that drives the cart has died") from None


class _Ended(BaseException):
    """SIGINT, SIGTERM, SIGHUP or the end of the parent: unwinds, so that the motor is stopped."""


def _serve(
    pipe: Connection, make_env: MakeEnv, make_policy: Callable[[], nn.Module], real_time: bool, parent: int
) -> None:
    endings = ending_signals()
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        endings.append(signal.SIGINT)  # of a terminal, to both processes: the parent may be starved
    RaiseOnce(_Ended).handle(*endings)
    end_with_parent(parent)
    torch.set_num_threads(1)
    with suppress(_Ended, EOFError, ConnectionError):
        try:
            _drive_on_demand(pipe, make_env, DrivingPolicy(make_policy()), real_time, parent)
        except CartPoleError as error:
            pipe.send(error)
        finally:
            for number in endings:  # the motor is off already
                signal.signal(number, signal.SIG_IGN)


def _drive_on_demand(
    pipe: Connection, make_env: MakeEnv, policy: DrivingPolicy, real_time: bool, parent: int
) -> None:
    """Drive an episode for each `EpisodeRequest` in the pipe, until it is closed."""
    with closing(make_env(partial(_ask, pipe))) as env:
        warm_up(env, policy)
        pipe.send(real_time and take_precedence())
        while True:
            pipe.send(_drive(env, policy, pipe.recv(), parent))


def _ask(pipe: Connection, text: str) -> bool:
    """Let the parent process ask the person at its terminal."""
    pipe.send(text)
    return bool(pipe.recv())


def _drive(env: CartPoleEnv, policy: DrivingPolicy, drive: EpisodeRequest, parent: int) -> Result:
    policy.load(drive.weights)
    random = np.random.default_rng(drive.seed)
    actions = len(env.hardware.motors)

    def act(current: TensorDictBase) -> TensorDictBase:
        if os.getppid() != parent:
            raise _Ended
        chosen = policy(current)
        if random.random() < drive.epsilon:
            chosen["action"] = torch.tensor([int(random.integers(actions))])
        return chosen

    (episode,) = run_batch(env, act)
    return episode, env.plant.statistics
