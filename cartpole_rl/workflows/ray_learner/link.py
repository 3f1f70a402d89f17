"""The link from the cart's machine to the learner: a process that may hang or die without harm to the cart.

It starts the Ray node of this machine, checks the versions, starts the learner or finds the one of an
interrupted run, and reports its progress. `LearnerLink` starts it again after it has died.
"""

import multiprocessing
import os
import signal
import subprocess
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from cartpole_rl.errors import CartPoleError, LearnerError, LearningError
from cartpole_rl.signals import end_with_parent
from cartpole_rl.workflows.ray_learner.node import (
    LEARNER,
    SETTINGS,
    START_RAY,
    cart_node,
    check_address,
    check_learners,
    fact_finder,
)
from cartpole_rl.workflows.ray_learner.task import LearnerTask, Report

NAMESPACE = "cartpole_rl"  # of Ray, for the names of learners
FIRST_CONNECTION = 600.0  # s; half a minute is usual, ten times as much beside other work
PAUSE = 5.0  # s before the link is started again
PERIOD = 1.0  # s between two reports
GIVE_UP = 45.0  # s without an answer, after which the link starts anew: Ray may have given up this node
GRACE = 15.0  # s from the request to end to SIGKILL
LOG = "learner_link.log"  # in the run folder: the output of Ray


@dataclass(frozen=True)
class Lost:
    """The learner does not answer."""

    reason: str
    ends_link: bool = False  # the link's process ends now


@dataclass(frozen=True)
class Finish:
    """The request to end the learner with the link."""


class LearnerLink:
    """A context manager of the link. `make_task` returns what a new learner continues from.

    `show` prints messages. The constructor waits until the learner answers; it raises LearnerError if it does
    not, or has other versions.
    """

    def __init__(
        self,
        address: str,
        timeout: float,
        make_task: Callable[[], LearnerTask],
        show: Callable[[str], None],
    ) -> None:
        self.address, self.timeout = address, timeout
        self.make_task, self.show = make_task, show
        self.is_lost = True
        self._reason: str | None = None  # of the loss that was shown last
        self._ending: str | None = None  # why the link's process ends, from that process
        self._was_connected = False
        self._known_learner, self._known = "", (0, 0)  # numbers of its curves and messages
        self.curves: list[tuple[int, dict[str, float]]] = []  # that `take_curves` has not returned yet
        self._started = 0.0
        show(f"connecting to the learner at {address}")
        self._start()
        try:
            self._wait()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "LearnerLink":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def poll(self) -> None:
        """Read what has arrived, and start the link again if it has ended.

        Raises LearningError if learning failed, LearnerError if the learner cannot be used.
        """
        try:
            while self._pipe.poll():
                self._take(self._pipe.recv())
        except (EOFError, ConnectionError):
            self._lose(self._ending or "its process on this machine ended")
            if time.monotonic() - self._started > PAUSE:
                self._end()
                self._start()

    def take_curves(self) -> list[tuple[int, dict[str, float]]]:
        """Return the curves that have arrived since the last call: numbers of episodes, and scalars."""
        taken, self.curves = self.curves, []
        return taken

    def finish(self) -> None:
        """End the learner: its last weights have arrived."""
        with suppress(OSError):
            self._pipe.send(Finish())
            self._process.join(GRACE)

    def close(self) -> None:
        """End the link. The learner waits for a resumption."""
        self._end()

    def _wait(self) -> None:
        end = time.monotonic() + FIRST_CONNECTION
        while self.is_lost:
            self.poll()
            if self._reason is not None or time.monotonic() > end:
                port, reason = self.address.rpartition(":")[2], f" ({self._reason})" if self._reason else ""
                raise LearnerError(
                    f"the learner at learner.address={self.address} does not answer{reason}; start Ray on "
                    f"its machine with {START_RAY.format(port=port)}, or give learner=local; {LOG} in the "
                    "run folder has Ray's output"
                )
            time.sleep(0.1)

    def _take(self, event: Any) -> None:
        match event:
            case LearnerError() if self._was_connected:  # another one may take its place
                self._take(Lost(str(event), ends_link=True))
            case CartPoleError():
                raise event
            case str():
                self.show(event)
            case Lost():
                self._ending = event.reason if event.ends_link else None
                self._lose(event.reason)
            case Report():
                if self.is_lost:
                    self.show("connected to the learner")
                self.is_lost, self._was_connected, self._reason = False, True, None
                self._take_news(event)

    def _take_news(self, report: Report) -> None:
        """Take curves and messages, except those that an earlier process of the link has reported."""
        known = self._known if report.learner == self._known_learner else (0, 0)
        curves, messages = (max(0, count - first) for count, first in zip(known, report.first, strict=True))
        self.curves += report.curves[curves:]
        for message in report.messages[messages:]:
            self.show(f"learner: {message}")
        self._known_learner = report.learner
        self._known = max(known[0], report.next[0]), max(known[1], report.next[1])

    def _lose(self, reason: str) -> None:
        if self._was_connected and reason != self._reason:
            self.show(f"the learner is lost: {reason}")
        self.is_lost, self._reason = True, reason

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, self.address, self.timeout, self.make_task(), os.getpid())
        )
        self._process.start()
        theirs.close()
        self._started, self._ending = time.monotonic(), None

    def _end(self) -> None:
        self._pipe.close()  # the process ends when it notices
        self._process.join(GRACE)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(pipe: Connection, address: str, timeout: float, task: LearnerTask, parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session gets it too, and ends this process
    end_with_parent(parent)
    os.environ.update(SETTINGS)
    with (task.folder / LOG).open("ab") as log:
        for standard in (1, 2):
            os.dup2(log.fileno(), standard)
    with suppress(EOFError, ConnectionError):
        try:
            check_address(address)
            with cart_node(address, task.cart) as node:
                _connect(address, node)
                _report(pipe, timeout, _learner(pipe, task), node)
        except CartPoleError as error:
            pipe.send(error)
        except ConnectionError as error:
            pipe.send(Lost(str(error), ends_link=True))
        except Exception as error:  # Ray's are of many kinds, and many lines long
            traceback.print_exc()
            pipe.send(Lost(f"{type(error).__name__}, see {LOG}", ends_link=True))
    os._exit(0)  # Ray's own way out waits for a cluster that may not answer


def _connect(address: str, node: "subprocess.Popen[bytes]") -> None:
    """Connect to the cluster through the node of this machine, as soon as that has joined.

    Raises ConnectionError if the node has ended.
    """
    import ray

    while not ray.is_initialized():
        if node.poll() is not None:
            raise ConnectionError(f"no Ray cluster answers at {address}")
        with suppress(ConnectionError, ValueError, LookupError):
            ray.init(address=address, namespace=NAMESPACE, log_to_driver=False, logging_level="ERROR")
        time.sleep(PERIOD)


def _learner(pipe: Connection, task: LearnerTask) -> Any:
    """Return the learner of this run, a new one or that of an earlier connection. Raises LearnerError."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    from cartpole_rl.workflows.ray_learner.learner import Learner

    def ask(node: str) -> Any:
        strategy = NodeAffinitySchedulingStrategy(node, soft=False)
        remote = ray.remote(fact_finder()).options(num_cpus=0, scheduling_strategy=strategy)
        return ray.get(remote.remote())

    for warning in check_learners(ray.nodes(), ask, ray.util.get_node_ip_address()):
        pipe.send(warning)
    if _is_busy(task.name):
        pipe.send(
            f"every {LEARNER} of the Ray cluster is busy with another fine-tuning, or with one that was "
            "interrupted within the last hour; this one waits"
        )
    return (
        ray.remote(Learner)
        .options(
            name=task.name,
            lifetime="detached",
            get_if_exists=True,
            num_cpus=0,
            resources={LEARNER: 1},
            max_concurrency=2,
        )
        .remote(task)
    )


def _is_busy(name: str) -> bool:
    """Return True if a new learner `name` would have to wait for another one to end."""
    import ray

    with suppress(ValueError):  # there is none of that name yet
        ray.get_actor(name)
        return False
    return ray.available_resources().get(LEARNER, 0) < 1


def _report(pipe: Connection, timeout: float, learner: Any, node: "subprocess.Popen[bytes]") -> None:
    """Send reports of the learner, until it does not answer any more, has failed, or is to end.

    Raises ConnectionError if the Ray node of this machine has ended.
    """
    import ray

    first = 0, 0
    ray.get(learner.report.remote(), timeout=FIRST_CONNECTION)
    answered = time.monotonic()
    while True:
        if node.poll() is not None:
            raise ConnectionError("the Ray node of this machine ended")
        try:
            report = ray.get(learner.report.remote(first), timeout=timeout)
        except ray.exceptions.GetTimeoutError:
            gives_up = time.monotonic() - answered > GIVE_UP
            pipe.send(Lost(f"no answer for {timeout:g} s", ends_link=gives_up))
            if gives_up:
                return
            continue
        answered = time.monotonic()
        first = report.next
        pipe.send(report)
        if report.failure is not None:
            ray.kill(learner)
            pipe.send(LearningError(f"the learner stopped: {report.failure}"))
            return
        if pipe.poll(PERIOD):
            pipe.recv()  # Finish
            ray.kill(learner)
            return
