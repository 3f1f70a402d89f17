"""The checks of the machines that offer a learner."""

import socket
import time
from contextlib import nullcontext, suppress
from threading import Thread
from typing import Any

import pytest

from cartpole_rl.errors import LearnerError
from cartpole_rl.workflows.ray_learner.node import check_address, check_learners, fact_finder

NODES = [
    {"NodeID": "gone", "Alive": False, "Resources": {"learner": 1}, "NodeManagerAddress": "10.0.0.1"},
    {"NodeID": "cart", "Alive": True, "Resources": {"cart_1": 1}, "NodeManagerAddress": "10.0.0.2"},
    {"NodeID": "server", "Alive": True, "Resources": {"learner": 1}, "NodeManagerAddress": "10.0.0.3"},
]
OWN = "10.0.0.2"


@pytest.fixture(autouse=True)
def _this_machine_has_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostbyname", lambda _: OWN)


def facts(clock: float = 0.0, resolved: str = "10.0.0.3", **versions: str | None) -> dict[str, Any]:
    """The facts of a machine like this one, with a clock that is `clock` s ahead, and other `versions`."""
    own = fact_finder()()
    return {
        "versions": {**own["versions"], **versions},
        "clock": time.time() + clock,
        "resolved": resolved,
    }


def test_the_same_versions_and_clocks_are_accepted() -> None:
    asked = []
    assert check_learners(NODES, lambda node: asked.append(node) or facts(), OWN) == []
    assert asked == ["server"]


def test_another_version_is_refused() -> None:
    text = (
        "other versions: torch .* here and 1.0 there, tensordict .* here and missing there; install the same"
    )
    with pytest.raises(LearnerError, match=text):
        check_learners(NODES, lambda _: facts(torch="1.0", tensordict=None), OWN)


@pytest.mark.parametrize(("ahead", "warnings"), [(-60.0, 1), (-2.0, 0), (2.0, 0), (60.0, 1)])
def test_clocks_that_differ_are_reported(ahead: float, warnings: int) -> None:
    found = check_learners(NODES, lambda _: facts(ahead), OWN)
    assert len(found) == warnings
    assert all("10.0.0.3 differs by 60 s" in text for text in found)


def test_a_cluster_without_a_learner_is_refused() -> None:
    with pytest.raises(LearnerError, match=r"no Ray node offers the resource learner: .* ray start --head"):
        check_learners(NODES[:2], lambda _: facts(), OWN)


def test_a_host_name_that_means_localhost_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        LearnerError, match=r"name of the learner's machine resolves to 127.0.1.1 .*/etc/hosts"
    ):
        check_learners(NODES, lambda _: facts(resolved="127.0.1.1"), OWN)
    monkeypatch.setattr(socket, "gethostbyname", lambda _: "127.0.1.1")
    with pytest.raises(LearnerError, match=r"name of the cart's machine resolves to 127.0.1.1"):
        check_learners(NODES, lambda _: facts(), OWN)
    assert check_learners(NODES, lambda _: facts(resolved="127.0.1.1"), "10.0.0.3") == []  # one machine


@pytest.mark.parametrize(
    ("answer", "tls", "reason"),
    [
        (bytes((0, 0, 0, 4, 0, 0, 0, 0, 0)), "", ""),
        (b"-ERR unknown command 'PRI'\r\n", "", "what listens there is not Ray"),
        (b"", "", "what listens there is not Ray"),
        (b"\x15\x03\x01", "1", ""),
        (b"\x15\x03\x01", "True", ""),
    ],
)
def test_only_a_grpc_server_is_accepted(
    answer: bytes, tls: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TLS hides what the server is."""
    monkeypatch.setenv("RAY_USE_TLS", tls)
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = Thread(target=answer_once, args=(server, answer), daemon=True)
        thread.start()
        expected = pytest.raises(ConnectionError, match=reason) if reason else nullcontext()
        with expected:
            check_address(f"127.0.0.1:{server.getsockname()[1]}")
        thread.join()


def answer_once(server: socket.socket, answer: bytes) -> None:
    connection, _ = server.accept()
    with connection, suppress(OSError):  # one that is closed at once
        connection.recv(1000)
        connection.sendall(answer)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ConnectionRefusedError(111, "Connection refused"), "Connection refused"),
        (socket.gaierror(-2, "Name or service not known"), "Name or service not known"),
        (TimeoutError("timed out"), "timed out"),
    ],
)
def test_an_address_that_cannot_be_reached_is_refused(
    error: OSError, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise error

    monkeypatch.setattr(socket, "create_connection", fail)
    with pytest.raises(ConnectionError, match=reason):
        check_address("server:6379")


@pytest.mark.parametrize("host", ["a..b", "a" * 64])
def test_a_name_that_no_host_can_have_is_refused(host: str) -> None:
    with pytest.raises(ConnectionError, match="labels of 1 to 63 characters"):
        check_address(f"{host}:6379")
