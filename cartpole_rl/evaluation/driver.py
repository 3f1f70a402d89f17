"""Drives a cart in a process of its own, so that nothing that learns, draws or writes can delay a tick.

The process does one thing at a time: it waits for a policy's weights, runs one episode, and sends it back. It
ends when the process that started it does, in the middle of an episode too, and every way out of it sets the
motor to 0 and disarms.
"""

import gc
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn

from cartpole_rl.envs.make import CartPoleEnv
from cartpole_rl.errors import CartPoleError, LinkError
from cartpole_rl.evaluation.driving_policy import DrivingPolicy, Weights
from cartpole_rl.evaluation.episodes import rehearse, run_batch
from cartpole_rl.plants.serial.faults import Confirm, nobody
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.serial.statistics import LinkStatistics
from cartpole_rl.scheduling import compute_first
from cartpole_rl.signals import RaiseOnce, end_with_parent, ending_signals
from cartpole_rl.tasks.episode import Episode

GRACE = 5.0  # s from SIGTERM to SIGKILL
MakeEnv = Callable[[Confirm], CartPoleEnv]  # over a cart whose faults are cleared if a person agrees


@dataclass(frozen=True)
class Drive:
    """One episode to be driven."""

    weights: Weights  # of the greedy policy
    epsilon: float  # share of random actions
    seed: int


@dataclass(frozen=True)
class Driven:
    """One episode that was driven, and what the link went through since the process began."""

    episode: Episode
    link: LinkStatistics


@dataclass(frozen=True)
class Question:
    """A fault that a person should confirm before it is cleared: True or False is the answer."""

    text: str


class Driver:
    """A process that drives the cart of `make_env` with the network of `make_policy`; a context manager.

    Both are called in that process, and their arithmetic is compiled there if `compiled`, before the first
    episode. `confirm` is called in this process, which has the terminal, while it waits for a result.
    Where the cart keeps its own clock, `real_time`, the process goes ahead of others if it may; `goes_first`
    is whether it does. Raises what making the environment raises there.
    """

    def __init__(
        self,
        make_env: MakeEnv,
        make_policy: Callable[[], nn.Module],
        compiled: bool,
        real_time: bool,
        confirm: Confirm = nobody,
    ) -> None:
        self._confirm = confirm
        context = multiprocessing.get_context("spawn")
        self._ours, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve,
            args=(theirs, make_env, make_policy, compiled, real_time, os.getpid()),
            daemon=True,
        )
        self._process.start()
        theirs.close()
        try:
            self.goes_first: bool = self._receive()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process id."""
        assert self._process.pid is not None
        return self._process.pid

    def start(self, drive: Drive) -> None:
        """Begin an episode, and return at once. Raises LinkError if the process died."""
        with _alive():
            self._ours.send(drive)

    def result(self) -> Driven:
        """Wait for the episode that was begun. Raises what ended it before it had begun, LinkError if the
        process died.
        """
        driven = self._receive()
        assert isinstance(driven, Driven)
        return driven

    def close(self) -> None:
        """Motor to 0, disarm, end the process."""
        self._process.terminate()
        self._process.join(GRACE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._ours.close()

    def __enter__(self) -> "Driver":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _receive(self) -> Any:
        with _alive():
            answer = self._ours.recv()
        while isinstance(answer, Question):
            agreed = self._confirm(answer.text)
            with _alive():
                self._ours.send(agreed)
                answer = self._ours.recv()
        if isinstance(answer, BaseException):
            raise answer
        return answer


@contextmanager
def _alive() -> Iterator[None]:
    """Raise LinkError where the other end of the pipe is gone."""
    try:
        yield
    except (EOFError, ConnectionError):
        raise LinkError("the process that drives the cart has died; start again with resume=") from None


class _Ended(BaseException):
    """SIGTERM or SIGHUP came, or the parent is gone: unwinds, so that the motor is stopped."""


def _serve(
    pipe: Connection,
    make_env: MakeEnv,
    make_policy: Callable[[], nn.Module],
    compiled: bool,
    real_time: bool,
    parent: int,
) -> None:
    endings = ending_signals()
    RaiseOnce(_Ended).handle(*endings)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent gets it too, and ends this one
    end_with_parent(parent)
    torch.set_num_threads(1)
    with suppress(_Ended, EOFError, ConnectionError):
        try:
            _drive_on_demand(
                pipe, make_env, DrivingPolicy(make_policy(), compiled), compiled, real_time, parent
            )
        except CartPoleError as error:
            pipe.send(error)
        finally:
            for number in endings:  # the motor is off; nothing is left to unwind
                signal.signal(number, signal.SIG_IGN)


def _drive_on_demand(
    pipe: Connection,
    make_env: MakeEnv,
    policy: DrivingPolicy,
    compiled: bool,
    real_time: bool,
    parent: int,
) -> None:
    """Drive an episode for each `Drive` that comes, until the pipe ends."""
    with closing(make_env(partial(_ask, pipe))) as env:
        if compiled:
            env.hardware.compile_arithmetic()
        rehearse(env, policy)
        pipe.send(real_time and compute_first())
        while True:
            pipe.send(_drive(env, policy, pipe.recv(), parent))


def _ask(pipe: Connection, text: str) -> bool:
    """Let the process that started this one ask the person at its terminal."""
    pipe.send(Question(text))
    return bool(pipe.recv())


def _drive(env: CartPoleEnv, policy: DrivingPolicy, drive: Drive, parent: int) -> Driven:
    policy.load(drive.weights)
    random = np.random.default_rng(drive.seed)
    actions = len(env.hardware.motors)

    def act(present: TensorDictBase) -> TensorDictBase:
        if os.getppid() != parent:
            raise _Ended
        chosen = policy(present)
        if random.random() < drive.epsilon:
            chosen["action"] = torch.tensor([int(random.integers(actions))])
        return chosen

    gc.collect()
    gc.disable()  # a collection in the middle of an episode takes longer than a tick allows
    try:
        (episode,) = run_batch(env, act)
    finally:
        gc.enable()
    assert isinstance(env.plant, SerialPlant)
    return Driven(episode, env.plant.cart.statistics)
