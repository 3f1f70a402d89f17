"""learner=ray without Ray: which weights drive which episode, the link, and the checks of the other machine.

The process of the link and the learner are made up; tests/commands/test_finetune_with_ray.py has a cluster.
"""

import itertools
import os
import socket
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import cache, partial
from multiprocessing import Pipe
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from short_episode import EPISODE

from cartpole_rl.errors import ConfigError, LearnerError, LearningError
from cartpole_rl.evaluation.driving_policy import Weights, as_weights
from cartpole_rl.learning.checkpoints import FINETUNING_FORMAT, AgentCheckpoint, load_training
from cartpole_rl.learning.settings import RayLearnerSettings
from cartpole_rl.workflows import ray_learner
from cartpole_rl.workflows.build import new_agent
from cartpole_rl.workflows.config import FinetuneConfig, TrainConfig, load_settings
from cartpole_rl.workflows.finetune import NAME, learn_there, take
from cartpole_rl.workflows.finetuning_cart import FinetuningFiles, Stage
from cartpole_rl.workflows.finetuning_learner import TunedAgent
from cartpole_rl.workflows.ray_learner import (
    Curves,
    Learner,
    LearnerLink,
    Link,
    Offer,
    Taken,
    check_address,
    check_versions,
    version_finder,
)

SETTINGS = RayLearnerSettings(kind="ray", address="server:6379", episodes_ahead=2, timeout=10.0)
CUT = b"\x00\x00\x00\x64x"  # the beginning of a message of 100 bytes in a pipe
CONFIG = {"run": "somewhere", "learner": SETTINGS.model_dump(), "episodes": 4, "evaluation_episodes": 1}


class Network:
    """A `LearnerLink` whose network is `happen`, which is called at each look; `news` arrive."""

    def __init__(self) -> None:
        self.settings, self.is_lost, self.is_finished = SETTINGS, False, False
        self.news: list[Offer | Curves] = []
        self.happen: Callable[[], None] = lambda: None

    def poll(self) -> list[Offer | Curves]:
        self.happen()
        news, self.news = self.news, []
        return news

    def finish(self) -> None:
        self.is_finished = True


class Cart:
    """A cart that drives at once; `driven` holds a weight of each episode."""

    def __init__(self, files: FinetuningFiles) -> None:
        self.files, self.config = files, files.config
        self.driven: list[float] = []
        self.curves: list[int] = []

    def start_tuning(self, number: int, weights: Weights) -> None:
        self.driven.append(float(next(iter(weights.values())).flat[0]))

    def finish(self, stage: Stage, number: int) -> None:
        self.files.write_episode(stage, number, EPISODE)

    def log_learning(self, curves: object, learned: int) -> None:
        self.curves.append(learned)


@cache
def training() -> TrainConfig:
    return load_settings(TrainConfig, {"agent.hidden": [8, 8]})


@cache
def new_weights() -> Weights:
    return as_weights(new_agent(training()))


def weights_of(value: float) -> Weights:
    """The weights of an agent, all of them `value`."""
    return {
        name: np.full_like(weight, value) if weight.dtype.kind == "f" else weight
        for name, weight in new_weights().items()
    }


class Session:
    """A run whose agent has the weights 0."""

    def __init__(self, folder: Path) -> None:
        self.files = FinetuningFiles(folder, load_settings(FinetuneConfig, CONFIG))
        state = {name: torch.tensor(weight) for name, weight in weights_of(0).items()}
        self.tuned = TunedAgent(
            training(), AgentCheckpoint(training().model_dump(mode="json"), state, 0, None), None
        )
        self.tuned.state[NAME] = "run"
        self.link, self.cart, self.looks = Network(), Cart(self.files), list[int]()

    def tune(self, happen: Callable[[int, int], None]) -> list[float]:
        """Drive; return the weights. Each look calls `happen` with the episodes and the looks at so many."""

        def look() -> None:
            count = self.files.count(Stage.TUNE)
            self.looks.append(count)
            happen(count, self.looks.count(count))

        self.link.happen = look
        learn_there(self.link, self.cart, self.tuned)
        return self.cart.driven

    def offer(self, version: int) -> None:
        self.link.news += [Curves(version, {}), Offer(version, weights_of(version))]


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Session:
    monkeypatch.setattr("cartpole_rl.workflows.finetune.POLL", 0.0)
    return Session(tmp_path)


@pytest.mark.parametrize("slow", [1, 50])
def test_each_episode_is_driven_with_the_weights_from_all_earlier_ones(slow: int, session: Session) -> None:
    driven = session.tune(lambda count, looks: session.offer(count) if looks == slow else None)
    assert driven == [0, 1, 2, 3]
    assert session.tuned.learned == 4
    assert session.cart.curves[-1] == 4
    assert session.link.is_finished


def test_without_a_learner_the_cart_drives_a_few_episodes_and_waits(
    session: Session, capsys: pytest.CaptureFixture[str]
) -> None:
    def lose(count: int, looks: int) -> None:
        session.link.is_lost = True
        if looks > 50:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session.tune(lose)
    assert session.cart.driven == [0, 0, 0]  # the first one needs no learner; 2 more are allowed
    assert session.looks.count(3) == 51
    assert [line.removeprefix("cartpole-finetune: ") for line in capsys.readouterr().err.splitlines()] == [
        "tune 2 is driven with weights from 0 episodes",
        "tune 3 is driven with weights from 0 episodes",
        "the cart waits for the learner; Ctrl-C stops, resume= continues",
    ]


def test_when_the_learner_returns_it_catches_up_first(session: Session) -> None:
    def return_late(count: int, looks: int) -> None:
        session.link.is_lost = count < 3 or (count == 3 and looks < 10)
        if not session.link.is_lost:
            session.offer(min(session.tuned.learned + 1, count))

    assert session.tune(return_late) == [0, 0, 0, 3]
    assert session.tuned.learned == 4


@pytest.mark.parametrize(
    ("version", "weights", "told"),
    [
        (1, lambda: weights_of(float("nan")), "version 1 of the learner's weights are refused: its weight "),
        (
            1,
            lambda: {"weight": np.full(3, 7.0)},
            "weights are refused: they are of another network; the earlier",
        ),
        (
            1,
            lambda: {name: each.astype("f2") for name, each in weights_of(7.0).items()},
            "of another network",
        ),
        (0, lambda: weights_of(7.0), ""),
        (5, lambda: weights_of(7.0), ""),
    ],
    ids=["nan", "another network", "another type", "same", "beyond the run"],
)
def test_weights_that_cannot_be_used_never_drive(
    version: int,
    weights: Callable[[], Weights],
    told: str,
    session: Session,
    capsys: pytest.CaptureFixture[str],
) -> None:
    take(Offer(version, weights()), session.files, session.tuned)
    assert session.tuned.learned == 0
    assert not any(weight.any() for weight in session.tuned.weights.values())
    assert told in capsys.readouterr().err


def test_weights_that_arrived_are_kept_for_a_resumption(session: Session) -> None:
    take(Offer(2, weights_of(2)), session.files, session.tuned)
    saved = load_training(session.files.folder, FINETUNING_FORMAT)
    resumed = TunedAgent(training(), session.tuned.start, saved)
    assert (resumed.learned, resumed.state[NAME]) == (2, "run")
    expected = weights_of(2)
    assert all(np.array_equal(expected[name], each) for name, each in as_weights(resumed.agent).items())


@pytest.mark.parametrize(("version", "curves"), [(0, [0, 1, 2, 3, 4]), (2, [3, 4])])
def test_a_resumption_logs_no_curve_again(version: int, curves: list[int], session: Session) -> None:
    """Its learner has waited, and sends all of its news to a session that has got none of them.

    Another one then takes over, and begins with the newest weights.
    """
    session.files.save({"agent": session.tuned.agent.state_dict(), NAME: "run"}, version)
    saved = load_training(session.files.folder, FINETUNING_FORMAT)
    session.tuned = TunedAgent(training(), session.tuned.start, saved)
    for each in (*range(5), 4):
        session.offer(each)
    session.tune(lambda count, looks: None)
    assert session.cart.curves == curves


class PipedLink(LearnerLink):
    """A link whose process is the test: `ends` are the pipe's at each start, `first` is sent at once."""

    first: Any = None

    def _start(self) -> None:
        self._pipe, end = ray_learner.impatient(Pipe())
        self._process = SimpleNamespace(join=lambda timeout=None: None, kill=lambda: None)
        self._answered = SimpleNamespace(value=0.0 if self.first else time.monotonic())
        self._started = self._read_at = self._listens_since = time.monotonic()
        self._ending = None
        self.ends = [*getattr(self, "ends", []), end]
        if self.first:
            end.send(self.first)

    def send(self, event: object) -> None:
        """Let an event arrive."""
        self.ends[-1].send(event)
        self._read()

    def wait(self, silent: float) -> None:
        """Let time pass without an answer while the session listens."""
        self._answered.value -= silent
        self._listens_since -= silent
        self._read()


def new_link(shown: list[str]) -> PipedLink:
    return PipedLink(SETTINGS, Path(), lambda first: [], lambda: None, shown.append)


@pytest.fixture
def shown() -> list[str]:
    return []


@pytest.fixture
def link(shown: list[str]) -> PipedLink:
    """A link that is connected."""
    link = new_link(shown)
    link.connect()
    return link


def test_a_loss_is_shown_once_and_a_link_that_hangs_is_started_again(
    link: PipedLink, shown: list[str]
) -> None:
    for _ in range(3):
        link.wait(11)
    assert link.is_lost
    link.wait(20)
    assert len(link.ends) == 2
    link.poll()
    assert not link.is_lost
    assert shown == [
        "connecting to the learner at server:6379",
        "connected to the learner",
        "the learner is lost: no answer for 10 s",
        "connected to the learner",
    ]


def test_a_link_that_waits_for_the_end_of_an_episode_is_not_lost(link: PipedLink) -> None:
    """Its pipe is full while the cart is driven."""
    link._read_at -= 20
    link.wait(20)
    assert not link.is_lost


@pytest.mark.parametrize(
    ("last", "reason"),
    [
        (ConnectionError("no Ray cluster"), "no Ray cluster"),
        (LearnerError("other versions"), "other versions"),  # another learner may take its place
        (None, "its process on this machine ended"),
        (CUT, "its process on this machine ended"),
    ],
)
def test_the_reason_of_a_process_that_ends_is_shown_and_it_is_started_again(
    last: object, reason: str, link: PipedLink, shown: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if isinstance(last, bytes):
        os.write(link.ends[0].fileno(), last)
    elif last is not None:
        link.send(last)
    link.ends[0].close()
    for _ in range(3):
        link.poll()
    assert link.is_lost
    assert shown[2:] == [f"the learner is lost: {reason}"]
    assert len(link.ends) == 1
    monkeypatch.setattr(ray_learner, "PAUSE", 0.0)
    link.poll()
    link.poll()
    assert len(link.ends) == 2
    assert not link.is_lost


def test_a_process_that_hangs_amid_a_message_is_started_again(
    shown: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_learner, "STUCK", 1)
    monkeypatch.setattr(ray_learner, "PAUSE", 0.0)
    link = new_link(shown)
    link.connect()
    os.write(link.ends[0].fileno(), CUT)
    link.poll()
    assert shown[-1] == "the learner is lost: its process on this machine hangs"
    assert len(link.ends) == 2


def test_a_learning_that_failed_ends_the_session(link: PipedLink) -> None:
    with pytest.raises(LearningError, match="diverged"):
        link.send((Taken("first", 1), [LearningError("diverged")]))


def test_a_learner_that_cannot_be_used_is_refused_at_the_start(
    shown: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PipedLink, "first", LearnerError("other versions"))
    with pytest.raises(LearnerError, match="other versions"):
        new_link(shown).connect()
    monkeypatch.setattr(PipedLink, "first", ConnectionError("Connection refused"))
    monkeypatch.setattr(ray_learner, "FIRST_CONNECTION", 0.5)
    link = new_link(shown)
    link.ends[0].close()
    with pytest.raises(LearnerError) as raised:
        link.connect()
    assert str(raised.value) == (
        "the learner at learner.address=server:6379 does not answer (Connection refused); start Ray on its "
        "machine with ray start --head --port=6379 --resources='{\"learner\": 1}', or give learner=local; "
        "learner_link.log in the run folder has Ray's output"
    )


def test_a_learner_takes_each_episode_once_and_repeats_no_news(monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer may be lost; a learner that took the place of another one has told nothing yet."""
    monkeypatch.setattr(Learner, "_tune", lambda learner: learner.news.append("fitted"))
    learner, episodes = Learner(SimpleNamespace()), [EPISODE, EPISODE.part(0, 1), EPISODE.part(0, 0)]
    while not learner.news:
        time.sleep(0.01)
    taken, news, count = learner.exchange(Taken(), 0, episodes[:2])
    assert (taken, news, count) == (Taken(learner.name, 1), ["fitted"], 2)
    assert learner.exchange(taken, 0, episodes) == (taken, [], 3)
    assert learner.exchange(Taken("another", 5), 3, []) == (taken, ["fitted"], 3)
    assert [episode.steps for episode in learner.first(3)] == [2, 1, 0]


class Ray:
    """What a link calls of Ray, in this process; a learner that ends keeps its name for `ending` looks."""

    exceptions = SimpleNamespace(GetTimeoutError=TimeoutError, RayActorError=OSError, ActorDiedError=OSError)

    def __init__(self, ending: int) -> None:
        self.killed, self.ending, self.util = list[Any](), ending, self

    def get(self, called: Callable[[], Any], timeout: float) -> Any:
        return called()

    def kill(self, learner: Any) -> None:
        self.killed.append(learner)

    def list_named_actors(self) -> list[str]:
        self.ending -= 1
        return ["run"] if self.ending >= 0 else []


def handle(learner: Learner) -> Any:
    """A learner as the link calls it."""
    return SimpleNamespace(exchange=SimpleNamespace(remote=lambda *given: partial(learner.exchange, *given)))


@pytest.mark.parametrize("moved", [True, False])
def test_a_learner_with_an_episode_that_was_moved_away_is_replaced(
    moved: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By one that gets the episode that is driven again; until it answers, the cart is not driven."""
    monkeypatch.setattr(Learner, "_tune", lambda learner: None)
    monkeypatch.setattr(ray_learner, "PERIOD", 0.0)
    monkeypatch.setitem(sys.modules, "ray", ray := Ray(ending=2))
    learners = [Learner(SimpleNamespace()) for _ in range(2)]
    for version, learner in enumerate(learners):
        learner.news.append(Offer(version, {}))
    handles, disk = [*map(handle, learners)], [EPISODE.part(0, steps) for steps in (2, 1, 0)]
    learners[0].exchange(Taken(), 0, disk)
    del disk[3 - moved :]
    session, end = Pipe()
    link = Link(end, SimpleNamespace(value=0.0), SETTINGS, lambda first: disk[first:], None, Taken())
    link.task = SimpleNamespace(name="run")

    def start() -> Any:
        assert (link.answered.value, ray.ending, ray.killed) == (0, -1, handles[:1])
        return handles[1]

    monkeypatch.setattr(link, "named_learner", start)
    looks = itertools.count()
    happens = {3: lambda: disk.append(EPISODE), 6: lambda: session.send("finish")}
    link.exchange(handles[0], SimpleNamespace(poll=lambda: happens.get(next(looks), lambda: None)()))
    assert link.answered.value > 0
    assert ray.killed == handles[: 1 + moved]
    assert learners[moved].episodes == disk
    told = [session.recv() for _ in range(1 + moved)]
    assert told[-1] == (Taken(learners[moved].name, 1), [Offer(int(moved), {})])
    line = "a recording was moved away since: a new learner starts, from the episodes on disk"
    assert told[:-1] == [line] * moved
    assert not session.poll()


def test_a_learning_that_fails_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for error, text in ((LearningError("diverged"), "diverged"), (KeyError("replay"), "KeyError: 'replay'")):

        def fail(_: Learner, error: Exception = error) -> None:
            raise error

        monkeypatch.setattr(Learner, "_tune", fail)
        learner = Learner(SimpleNamespace())
        while not learner.news:
            time.sleep(0.01)
        assert str(learner.news[0]) == f"the learner stopped: {text}"


NODES = [
    {"NodeID": "gone", "Alive": False, "Resources": {"learner": 1}},
    {"NodeID": "cart", "Alive": True, "Resources": {"memory": 1}},
    {"NodeID": "server", "Alive": True, "Resources": {"learner": 1}},
]


def test_machines_that_offer_a_learner_need_the_same_versions() -> None:
    own, asked = version_finder()(), list[str]()
    assert own["torch"]
    check_versions(NODES, lambda node: asked.append(node) or own)
    assert asked == ["server"]
    text = (
        "other versions: torch .* here and 1.0 there, tensordict .* here and missing there; install the same"
    )
    with pytest.raises(LearnerError, match=text):
        check_versions(NODES, lambda _: {**own, "torch": "1.0", "tensordict": None})
    with pytest.raises(LearnerError, match=r"no Ray node offers the resource learner: .* ray start --head"):
        check_versions(NODES[:2], lambda _: own)


@pytest.mark.parametrize(
    ("answer", "tls", "reason"),
    [
        (bytes((0, 0, 0, 4, 0, 0, 0, 0, 0)), "", ""),
        (b"", "", "what listens there is not Ray"),
        (b"\x15\x03\x01", "1", ""),  # TLS hides what the server is
    ],
)
def test_only_a_grpc_server_is_accepted(
    answer: bytes, tls: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_USE_TLS", tls)
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = Thread(target=answer_once, args=(server, answer), daemon=True)
        thread.start()
        with pytest.raises(ConnectionError, match=reason) if reason else nullcontext():
            check_address(f"127.0.0.1:{server.getsockname()[1]}")
        thread.join()


def answer_once(server: socket.socket, answer: bytes) -> None:
    connection, _ = server.accept()
    with connection, suppress(OSError):  # one that is closed at once
        connection.recv(1000)
        connection.sendall(answer)


@pytest.mark.parametrize(
    "error", [ConnectionRefusedError(111, "Connection refused"), TimeoutError("timed out")]
)
def test_an_address_that_cannot_be_reached_is_refused(
    error: OSError, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(socket, "create_connection", fail)
    with pytest.raises(ConnectionError, match=error.strerror or str(error)):
        check_address("server:6379")


@pytest.mark.parametrize("address", ["server", "ray://server:10001", "server:637900"])
def test_an_address_has_a_host_and_a_port(address: str) -> None:
    with pytest.raises(ConfigError, match=r"learner\.address=.*: give host:port"):
        load_settings(FinetuneConfig, {**CONFIG, "learner": {**CONFIG["learner"], "address": address}})
