"""The learner of learner=ray, an actor of Ray on another machine than the cart's, and the link to it.

The cart's machine calls `exchange` again and again: it gives episodes, and gets weights, curves and messages.
Weights carry a version, the number of episodes that had been learned from: version n drives episode n, as on
one machine. The learner outlives a lost connection, and ends when no cart asks for it any more.

The link is a process that starts a Ray node on the cart's machine and calls the learner. It may hang or die
without harm: the processes that drive and write episodes use neither Ray nor the network.
"""

import logging
import multiprocessing
import os
import platform
import secrets
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from ctypes import CDLL
from dataclasses import dataclass
from importlib.metadata import distributions
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from cartpole_rl.errors import CartPoleError, LearnerError, LearningError
from cartpole_rl.evaluation.driving_policy import Weights, as_weights
from cartpole_rl.learning.checkpoints import AgentCheckpoint, TrainingCheckpoint
from cartpole_rl.learning.dqn import Scalars
from cartpole_rl.learning.settings import RayLearnerSettings
from cartpole_rl.learning.states import seed_everything
from cartpole_rl.signals import end_with_parent
from cartpole_rl.tasks.episode import Episode
from cartpole_rl.workflows.build import evaluated_settings, new_agent, use_threads
from cartpole_rl.workflows.config import EvaluateConfig, FinetuneConfig, TrainConfig, recorded_settings
from cartpole_rl.workflows.finetuning_learner import CartLearner, TunedAgent, check_simulation

ABANDONED = 3600.0  # s without a call of `exchange`, after which the learner ends
POLL = 0.05  # s between two looks for an episode
LEARNER = "learner"  # the Ray resource that a machine for learners offers
LOG = "learner_link.log"  # in the run folder: the output of Ray
START_RAY = "ray start --head --port={port} --resources='{{\"learner\": 1}}'"
PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "ray")  # of the same version on both machines
SETTINGS = {  # of Ray
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_raylet_start_wait_time_s": "300",  # the default is too little beside other work
    "RAY_worker_niceness": "0",
    "OMP_NUM_THREADS": "1",
}
STORE = 100_000_000  # bytes of Ray's object store on the cart's machine; an episode takes 50 kB
HTTP2_START = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))  # RFC 9113, 3.4
HTTP2_SETTINGS, HTTP2_HEADER = 4, 9  # the type of a server's first frame, bytes of its header
ANSWER = 10.0  # s for an answer from the cluster's address
FIRST_CONNECTION = 600.0  # s; half a minute is usual, ten times as much beside other work
PERIOD = 0.2  # s between two calls of the learner
PAUSE = 5.0  # s before the process is started again
GIVE_UP = 45.0  # s without an answer, after which it is started again: Ray may have given up this node
GRACE = 15.0  # s from the request to end to SIGKILL
STUCK = 10  # s in which the next part of a message has to arrive; longer than PAUSE

Episodes = Callable[[int], list[Episode]]  # those on disk, from a number on


@dataclass(frozen=True)
class LearnerTask:
    """All that a learner needs to start, or to continue from `newest`."""

    name: str  # of the run; the same after a resumption
    evaluation: Mapping[str, Any]  # settings of the driving
    start: AgentCheckpoint
    newest: TrainingCheckpoint  # settings of the fine-tuning, weights, and number of episodes learned from


class Offer(NamedTuple):
    """Weights of the whole agent that were learned from `version` episodes."""

    version: int
    weights: Weights


class Curves(NamedTuple):
    """Scalars for TensorBoard after `learned` episodes."""

    learned: int
    scalars: Scalars


class Taken(NamedTuple):
    """The first `total` news of the learner with the name `learner`: what the cart's machine has got."""

    learner: str = ""
    total: int = 0


News = Offer | Curves | str | LearningError  # str: a message; LearningError: learning has ended


class Learner:
    """Learns in a thread from its construction on. `exchange` is called at the same time."""

    def __init__(self, task: LearnerTask) -> None:
        self.task, self.name = task, secrets.token_hex(8)
        self.episodes: list[Episode] = []  # evaluations first
        self.news: list[News] = []
        self._asked = time.monotonic()
        for run in (self._learn, self._end_when_abandoned):
            threading.Thread(target=run, daemon=True).start()

    def exchange(
        self, taken: Taken, first: int, episodes: Sequence[Episode]
    ) -> tuple[Taken, list[News], int]:
        """Take `episodes`, which are numbered from `first`; return the news after those `taken`.

        Also returns what is taken with them, and the number of episodes that have arrived.
        """
        self._asked = time.monotonic()
        self.episodes += episodes[len(self.episodes) - first :]  # some may have come before
        start = taken.total if taken.learner == self.name else 0
        news = self.news[start:]
        return Taken(self.name, start + len(news)), news, len(self.episodes)

    def first(self, count: int) -> list[Episode]:
        """Wait for the first `count` episodes, and return them."""
        while len(self.episodes) < count:
            time.sleep(POLL)
        return self.episodes[:count]

    def _learn(self) -> None:
        try:
            self._tune()
        except CartPoleError as error:
            self.news.append(LearningError(f"the learner stopped: {error}"))
        except Exception as error:  # a defect; without this line it would be in a log file of Ray alone
            self.news.append(LearningError(f"the learner stopped: {type(error).__name__}: {error}"))

    def _tune(self) -> None:
        """Learn as `workflows.finetune.learn_here` does, with the same random numbers."""
        task, news = self.task, self.news
        config = recorded_settings(FinetuneConfig, task.newest.config, "the run")
        training = recorded_settings(TrainConfig, task.start.config, "the agent")
        evaluation = recorded_settings(EvaluateConfig, task.evaluation, "the run")
        check_simulation(training)
        use_threads(config.threads)
        seed_everything(config.seed)
        new_agent(training)  # as the one that `finetune` reads the settings of
        tuned = TunedAgent(training, task.start, task.newest)
        settings = evaluated_settings(training, evaluation)
        learner = CartLearner(config, training, settings, tuned.agent, news.append)
        before, learned = config.evaluation_episodes, tuned.learned
        news.append(Curves(learned, learner.start(self.first(before + learned), learned)))
        for number in range(learned, config.episodes):
            news.append(Offer(number, as_weights(tuned.agent)))
            curves = learner.round()
            learner.add(self.first(before + number + 1)[-1])
            news.append(Curves(number + 1, curves))
        news.append(Offer(config.episodes, as_weights(tuned.agent)))

    def _end_when_abandoned(self) -> None:
        while time.monotonic() - self._asked < ABANDONED:
            time.sleep(1)
        os._exit(0)


class LearnerLink:
    """The link as its session sees it; its process is started again when it has ended or hangs.

    `folder` is the run's; `make_task` returns what a new learner continues from; `show` prints a message.
    """

    def __init__(
        self,
        settings: RayLearnerSettings,
        folder: Path,
        episodes: Episodes,
        make_task: Callable[[], LearnerTask],
        show: Callable[[str], None],
    ) -> None:
        self.settings, self.folder, self.episodes = settings, folder, episodes
        self.make_task, self.show = make_task, show
        self.is_lost, self._was_connected = True, False
        self._reason: str | None = None  # of the loss that was shown last
        self._ending: str | None = None  # why the process ends, from that process
        self._taken, self._news = Taken(), list[Offer | Curves]()
        self._started = self._read_at = self._listens_since = 0.0
        self._start()

    def connect(self) -> None:
        """Wait until the learner answers. Raises LearnerError if it does not, or cannot be used."""
        address = self.settings.address
        self.show(f"connecting to the learner at {address}")
        end = time.monotonic() + FIRST_CONNECTION
        while self.is_lost:
            self._read()
            if self._reason is not None or time.monotonic() > end:
                port, reason = address.rpartition(":")[2], f" ({self._reason})" if self._reason else ""
                raise LearnerError(
                    f"the learner at learner.address={address} does not answer{reason}; start Ray on its "
                    f"machine with {START_RAY.format(port=port)}, or give learner=local; {LOG} in the run "
                    "folder has Ray's output"
                )
            time.sleep(PERIOD)

    def poll(self) -> list[Offer | Curves]:
        """Return what has arrived since the last call, and keep the process alive.

        Raises LearningError if learning has failed.
        """
        self._read()
        news, self._news = self._news, []
        return news

    def finish(self) -> None:
        """End the learner: its last weights have arrived."""
        with suppress(OSError):
            self._pipe.send("finish")
            self._process.join(GRACE)

    def close(self) -> None:
        """End the process. The learner waits for a resumption."""
        self._pipe.close()  # the process ends when it notices
        self._process.join(GRACE)
        self._process.kill()
        self._process.join()

    def _read(self) -> None:
        try:
            while self._pipe.poll():
                self._receive(self._pipe.recv())
        except (EOFError, OSError) as error:  # also in the middle of a message
            ended = "hangs" if isinstance(error, BlockingIOError) else "ended"
            self._lose(self._ending or f"its process on this machine {ended}")
            if time.monotonic() - self._started > PAUSE:
                self._restart()
            return
        now, answered, timeout = time.monotonic(), self._answered.value, self.settings.timeout
        if now - self._read_at > timeout / 2:  # the cart was driven: the process may have waited to send
            self._listens_since = now
        self._read_at = now
        silent = now - max(answered, self._listens_since)
        if answered and now - answered <= timeout and self.is_lost:
            self.show("connected to the learner")
            self.is_lost, self._was_connected, self._reason = False, True, None
        elif answered and silent > timeout:
            self._lose(f"no answer for {timeout:g} s")
        if silent > (GIVE_UP if answered else FIRST_CONNECTION):
            self._restart()

    def _receive(self, event: Any) -> None:
        match event:
            case LearnerError() if not self._was_connected:  # later, another learner may take its place
                raise event
            case Exception():
                self._ending = str(event)
            case str():
                self.show(event)
            case taken, news:
                self._taken = taken
                for each in news:
                    if isinstance(each, LearningError):
                        raise each
                    if isinstance(each, str):
                        self.show(f"learner: {each}")
                    else:
                        self._news.append(each)

    def _lose(self, reason: str) -> None:
        if self._was_connected and reason != self._reason:
            self.show(f"the learner is lost: {reason}")
        self.is_lost, self._reason = True, reason

    def _restart(self) -> None:
        self._process.kill()
        self._process.join()
        self._pipe.close()
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = impatient(context.Pipe())
        self._answered = context.Value("d", 0.0, lock=False)  # time of the last answer; 0: none yet
        work = theirs, self._answered, self.settings, self.episodes, self.make_task(), self._taken
        self._process = context.Process(target=Link(*work).run, args=(self.folder / LOG, os.getpid()))
        self._process.start()
        theirs.close()
        self._started = self._listens_since = self._read_at = time.monotonic()
        self._ending = None


def impatient(pipe: tuple[Connection, Connection]) -> tuple[Connection, Connection]:
    """Return a pipe whose first end raises BlockingIOError if a message stops arriving for STUCK s."""
    with socket.socket(fileno=os.dup(pipe[0].fileno())) as end:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", STUCK, 0))
    return pipe


@dataclass
class Link:
    """The work of the process, between the session at the other end of `pipe` and the learner."""

    pipe: Connection
    answered: Any  # shared with the session
    settings: RayLearnerSettings
    episodes: Episodes
    task: LearnerTask
    taken: Taken

    def run(self, log: Path, parent: int) -> None:
        """Connect and exchange, until the session, the learner or Ray ends; tell the session why."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session gets it too, and ends this process
        end_with_parent(parent)
        os.environ.update(SETTINGS)
        with log.open("ab") as file:
            for standard in (1, 2):
                os.dup2(file.fileno(), standard)
        with suppress(EOFError, ConnectionError):
            try:
                check_address(self.settings.address)
                with joined(self.settings.address) as node:
                    self.exchange(self.learner(), node)
            except (CartPoleError, ConnectionError, EOFError) as error:
                self.pipe.send(error)
            except Exception as error:  # Ray's are of many kinds, and many lines long
                traceback.print_exc()
                self.pipe.send(ConnectionError(f"{type(error).__name__}, see {LOG}"))
        os._exit(0)  # Ray's own way out waits for a cluster that may not answer

    def learner(self) -> Any:
        """Return the learner of this run, a new one or that of an earlier connection. Raises LearnerError."""
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        def ask(node: str) -> Any:
            there = {"scheduling_strategy": NodeAffinitySchedulingStrategy(node, soft=False), "num_cpus": 0}
            return ray.get(ray.remote(version_finder()).options(**there).remote())

        check_versions(ray.nodes(), ask)
        name = self.task.name
        if name not in ray.util.list_named_actors() and ray.available_resources().get(LEARNER, 0) < 1:
            self.pipe.send(
                f"every {LEARNER} of the Ray cluster is busy with another fine-tuning, or with one that was "
                "interrupted within the last hour; this one waits"
            )
        return self.named_learner()

    def named_learner(self) -> Any:
        """Return the learner with the name of this run, a new one if there is none."""
        import ray

        options = {"name": self.task.name, "lifetime": "detached", "get_if_exists": True, "num_cpus": 0}
        return ray.remote(Learner).options(**options, resources={LEARNER: 1}).remote(self.task)

    def replaced(self, learner: Any) -> Any:
        """End a learner with an episode that is no longer on disk; return one that starts from the task."""
        import ray

        self.pipe.send("a recording was moved away since: a new learner starts, from the episodes on disk")
        ray.kill(learner)
        while self.task.name in ray.util.list_named_actors():  # it is ending
            time.sleep(PERIOD)
        return self.named_learner()

    def exchange(self, learner: Any, node: "subprocess.Popen[bytes]") -> None:
        """Send the learner each episode on disk, and the session the learner's news.

        Returns once learning has failed or is to end. Raises ConnectionError if the learner or the Ray node
        of this machine has ended, EOFError if the session has.
        """
        import ray

        arrived, episodes, patience, is_first = 0, list[Episode](), FIRST_CONNECTION, True
        while node.poll() is None:
            try:
                answer = ray.get(learner.exchange.remote(self.taken, arrived, episodes), timeout=patience)
            except ray.exceptions.GetTimeoutError:
                continue
            except ray.exceptions.RayActorError as error:
                print(error, file=sys.stderr)
                died = isinstance(error, ray.exceptions.ActorDiedError)
                reason = "its process ended" if died else "the connection broke"
                raise ConnectionError(f"{reason}, see {LOG}") from None
            taken, news, arrived = answer
            if is_first and arrived and not self.episodes(arrived - 1):  # of a run that is resumed
                learner, arrived = self.replaced(learner), 0
                continue
            self.answered.value, patience, is_first = time.monotonic(), self.settings.timeout, False
            if news:
                self.pipe.send((taken, news))
                self.taken = taken
            failed = any(isinstance(each, LearningError) for each in news)
            if failed or (self.pipe.poll(PERIOD) and self.pipe.recv()):
                ray.kill(learner)
                return
            episodes = self.episodes(arrived)
        raise ConnectionError("the Ray node of this machine ended")


@contextmanager
def joined(address: str) -> "Iterator[subprocess.Popen[bytes]]":
    """Run a Ray node on this machine that offers nothing to the cluster at `address`, and connect through it.

    The node ends with this process, even if that is killed. Raises ConnectionError if there is no cluster.
    """
    import ray

    command = [sys.executable, "-m", "ray.scripts.scripts", "start", f"--address={address}", "--block"]
    node = subprocess.Popen(
        [*command, "--num-cpus=0", "--num-gpus=0", f"--object-store-memory={STORE}"],
        env={**os.environ, **SETTINGS},
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=_end_with_parent if sys.platform == "linux" else None,
    )
    try:
        while not ray.is_initialized():
            if node.poll() is not None:
                raise ConnectionError(f"no Ray cluster answers at {address}")
            with suppress(ConnectionError, ValueError, LookupError):  # not joined yet
                ray.init(
                    address=address, namespace="cartpole_rl", log_to_driver=False, logging_level=logging.ERROR
                )
            time.sleep(PERIOD)
        yield node
    finally:
        node.kill()  # its processes end with it
        node.wait()


def _end_with_parent() -> None:
    CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def check_address(address: str) -> None:
    """Raise ConnectionError if no gRPC server, as Ray's, answers at `address`; Ray itself takes minutes."""
    host, _, port = address.rpartition(":")
    try:
        connection = socket.create_connection((host, int(port)), ANSWER)
        with connection, connection.makefile("rb") as file:
            if os.environ.get("RAY_USE_TLS", "").lower() in ("1", "true"):  # hides what a server is
                return
            connection.sendall(HTTP2_START)
            header = file.read(HTTP2_HEADER)
    except OSError as error:
        raise ConnectionError(error.strerror or str(error)) from error
    except UnicodeError as error:
        raise ConnectionError("a host's name has labels of 1 to 63 characters") from error
    if len(header) < HTTP2_HEADER or header[3] != HTTP2_SETTINGS:
        raise ConnectionError("what listens there is not Ray")


def version_finder() -> Callable[[], dict[str, str | None]]:
    """Return a function that returns the versions on the machine that calls it.

    Ray sends a nested function by value, so that machine need not have this package.
    """

    def versions() -> dict[str, str | None]:
        found = {name: next((each.version for each in distributions(name=name)), None) for name in PACKAGES}
        return {"Python": ".".join(platform.python_version_tuple()[:2]), **found}

    return versions


def check_versions(
    nodes: Iterable[Mapping[str, Any]], ask: Callable[[str], Mapping[str, str | None]]
) -> None:
    """Raise LearnerError if none of Ray's `nodes` offers LEARNER, or one that does has other versions.

    `ask` returns the versions of a node by its id.
    """
    here = version_finder()()
    offering = [node["NodeID"] for node in nodes if node["Alive"] and LEARNER in node["Resources"]]
    if not offering:
        start = START_RAY.format(port=6379)
        raise LearnerError(
            f"no Ray node offers the resource {LEARNER}: on the learner's machine, start Ray with {start}"
        )
    for there in map(ask, offering):
        differing = [
            f"{name} {own} here and {there.get(name) or 'missing'} there"
            for name, own in here.items()
            if own != there.get(name)
        ]
        if differing:
            raise LearnerError(
                f"the cart's and the learner's machine have other versions: {', '.join(differing)}; install "
                "the same ones on both"
            )
