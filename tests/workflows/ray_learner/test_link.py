"""The link's process can die, hang or be refused; the session learns of it by `is_lost`."""

import sys
import time
from contextlib import suppress
from multiprocessing import Pipe
from typing import Any

import pytest

from cartpole_rl.errors import LearnerError, LearningError
from cartpole_rl.workflows.ray_learner import link as module
from cartpole_rl.workflows.ray_learner.link import LearnerLink, Lost
from cartpole_rl.workflows.ray_learner.task import Report


class Ended:
    """A process that has ended."""

    def join(self, timeout: float | None = None) -> None:
        pass

    def is_alive(self) -> bool:
        return False


class PipedLink(LearnerLink):
    """A link whose process is the test: `ends` holds the other end of the pipe of each start."""

    def _start(self) -> None:
        self._pipe, end = Pipe()
        self._process: Any = Ended()
        self._started, self._ending = time.monotonic(), None
        self.ends = [*getattr(self, "ends", []), end]
        if len(self.ends) == 1:
            end.send(Report("first"))


@pytest.fixture
def shown() -> list[str]:
    return []


@pytest.fixture
def link(shown: list[str]) -> PipedLink:
    """A link that is connected."""
    return PipedLink("server:6379", 10.0, lambda: pytest.fail("not needed"), shown.append)


def test_a_loss_is_shown_once_with_its_reason(link: PipedLink, shown: list[str]) -> None:
    for event in (
        Lost("no answer"),
        Lost("no answer"),
        Lost("no Ray cluster"),
        Report("first"),
        Lost("no answer"),
    ):
        link.ends[0].send(event)
        link.poll()
    assert link.is_lost
    assert shown == [
        "connecting to the learner at server:6379",
        "connected to the learner",
        "the learner is lost: no answer",
        "the learner is lost: no Ray cluster",
        "connected to the learner",
        "the learner is lost: no answer",
    ]


@pytest.mark.parametrize("last", [Lost("no Ray cluster", ends_link=True), LearnerError("no Ray cluster")])
def test_the_reason_of_a_process_that_ends_is_kept(last: object, link: PipedLink, shown: list[str]) -> None:
    link.ends[0].send(last)
    link.ends[0].close()
    for _ in range(3):
        link.poll()
    assert shown[2:] == ["the learner is lost: no Ray cluster"]


def test_a_process_that_dies_while_the_learner_is_lost_is_shown(link: PipedLink, shown: list[str]) -> None:
    link.ends[0].send(Lost("no answer"))
    link.ends[0].close()
    for _ in range(3):
        link.poll()
    assert shown[2:] == [
        "the learner is lost: no answer",
        "the learner is lost: its process on this machine ended",
    ]


def test_a_process_that_ended_is_started_again_after_a_pause(
    link: PipedLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    link.ends[0].close()
    link.poll()
    assert link.is_lost
    assert len(link.ends) == 1
    monkeypatch.setattr(module, "PAUSE", 0.0)
    link.poll()
    assert len(link.ends) == 2
    link.ends[1].send(Report("first"))
    link.poll()
    assert not link.is_lost


def test_curves_are_taken_once(link: PipedLink, shown: list[str]) -> None:
    """A new process of the link reports from the beginning, a new learner has other curves."""
    curves = [(number, {"loss": 2.0}) for number in range(3)]
    for report, taken in (
        (Report("first", (0, 0), curves[:1], ["fitted"]), curves[:1]),
        (Report("first", (1, 1), curves[1:2]), curves[1:2]),
        (Report("first", (0, 0), curves[:2], ["fitted"]), []),
        (Report("first", (2, 1), curves[2:]), curves[2:]),
        (Report("second", (0, 0), curves[:1], ["fitted anew"]), curves[:1]),
    ):
        link.ends[0].send(report)
        link.poll()
        assert link.take_curves() == taken
    assert link.take_curves() == []
    assert shown[-2:] == ["learner: fitted", "learner: fitted anew"]


def test_a_learning_that_failed_ends_the_session(link: PipedLink) -> None:
    link.ends[0].send(LearningError("diverged"))
    with pytest.raises(LearningError, match="diverged"):
        link.poll()


def test_other_versions_end_a_session_only_at_its_start(
    link: PipedLink, shown: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    link.ends[0].send(LearnerError("other versions"))
    link.poll()
    assert link.is_lost
    assert shown[-1] == "the learner is lost: other versions"

    def refuse(self: PipedLink) -> None:
        self._pipe, end = Pipe()
        self._process = Ended()
        end.send(LearnerError("other versions"))

    monkeypatch.setattr(PipedLink, "_start", refuse)
    with pytest.raises(LearnerError, match="other versions"):
        PipedLink("server:6379", 10.0, lambda: pytest.fail("not needed"), shown.append)


def test_an_address_without_a_cluster_is_given_up(shown: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def start_in_vain(self: PipedLink) -> None:
        self._pipe, _ = Pipe()
        self._process, self._started = Ended(), time.monotonic()

    monkeypatch.setattr(PipedLink, "_start", start_in_vain)
    monkeypatch.setattr(module, "FIRST_CONNECTION", 0.2)
    with pytest.raises(LearnerError, match=r"server:6379 does not answer.*; start Ray .* --port=6379"):
        PipedLink("server:6379", 10.0, lambda: pytest.fail("not needed"), shown.append)


@pytest.mark.parametrize(("patience", "last"), [(-1.0, True), (1000.0, False)])
def test_only_the_last_report_of_a_silent_learner_ends_the_link(
    patience: float, last: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray's own answers are made up here; scripts/bench/two_machines.py has a cluster."""
    silent = SilentRay(answers=1)
    monkeypatch.setitem(sys.modules, "ray", silent)
    monkeypatch.setattr(module, "GIVE_UP", patience)
    ours, theirs = Pipe()
    with suppress(InterruptedError):
        module._report(theirs, 10.0, silent, silent)
    assert ours.recv() == Lost("no answer for 10 s", ends_link=last)


class SilentRay:
    """Ray, a learner in it and a node of it: the learner answers a few times, then never again."""

    def __init__(self, answers: int) -> None:
        self.answers, self.exceptions, self.report = answers, self, self

    class GetTimeoutError(Exception):
        pass

    def remote(self, *_: object) -> None:
        pass

    def poll(self) -> None:
        pass

    def get(self, _: object, timeout: float) -> Report:
        self.answers -= 1
        if self.answers < -1:
            raise InterruptedError  # enough for the test
        if self.answers < 0:
            raise self.GetTimeoutError
        return Report("first")
