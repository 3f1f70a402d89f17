"""The Ray node on the machine of the cart, and the checks of the machine that offers the learner."""

import ctypes
import os
import platform
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from cartpole_rl.errors import LearnerError

LEARNER = "learner"  # the Ray resource that a machine for learners offers
PACKAGES = ("cartpole_rl", "torch", "torchrl", "tensordict", "ray")
CLOCKS = 5.0  # s of difference between two clocks, from which it is reported
STORE = 100_000_000  # bytes of Ray's object store on the cart's machine; an episode takes 50 kB
STOP = 10.0  # s from SIGTERM to SIGKILL
ANSWER = 10.0  # s for an answer from the cluster's address
HTTP2_START = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes((0, 0, 0, 4, 0, 0, 0, 0, 0))  # RFC 9113, 3.4
HTTP2_SETTINGS, HTTP2_HEADER = 4, 9  # the type of a server's first frame, bytes of its header
SETTINGS = {  # of Ray
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_raylet_start_wait_time_s": "300",  # the default is too little beside other work
    "RAY_worker_niceness": "0",
    "OMP_NUM_THREADS": "1",
}
START_RAY = "ray start --head --port={port} --resources='{{\"learner\": 1}}'"


def check_address(address: str) -> None:
    """Raise ConnectionError if no gRPC server, as Ray's, answers at `address`; Ray itself takes minutes."""
    host, _, port = address.rpartition(":")
    try:
        with (
            socket.create_connection((host, int(port)), ANSWER) as connection,
            connection.makefile("rb") as file,
        ):
            if encrypted():
                return
            connection.sendall(HTTP2_START)
            header = file.read(HTTP2_HEADER)
    except OSError as error:
        raise ConnectionError(error.strerror or str(error)) from error
    except UnicodeError as error:
        raise ConnectionError("a host's name has labels of 1 to 63 characters") from error
    if len(header) < HTTP2_HEADER or header[3] != HTTP2_SETTINGS:
        raise ConnectionError("what listens there is not Ray")


def encrypted() -> bool:
    """Return True if Ray uses TLS, which hides what a server is."""
    return os.environ.get("RAY_USE_TLS", "").lower() in ("1", "true")


@contextmanager
def cart_node(address: str, resource: str) -> "Iterator[subprocess.Popen[bytes]]":
    """Run a Ray node on this machine that joins the cluster at `address` and offers `resource`.

    It runs nothing but what asks for that resource. It ends with this process, even if that is killed. The
    yielded process ends early if the cluster cannot be reached.
    """
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", f"--address={address}", "--block"]
    limits = ["--num-cpus=0", "--num-gpus=0", f"--object-store-memory={STORE}"]
    process = subprocess.Popen(
        [*command, *limits, f'--resources={{"{resource}": 1}}'],
        env={**os.environ, **SETTINGS},
        stdin=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=_end_with_parent,
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(STOP)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _end_with_parent() -> None:
    """Let Linux end this process with its parent (PR_SET_PDEATHSIG)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGTERM)


def fact_finder() -> Callable[[], dict[str, Any]]:
    """Return a function that returns versions, clock (s) and own address of the machine that calls it.

    Ray sends a nested function by value, so that machine need not have this package.
    """

    def facts() -> dict[str, Any]:
        found: dict[str, str | None] = {"Python": ".".join(platform.python_version_tuple()[:2])}
        for name in PACKAGES:
            try:
                found[name] = version(name)
            except PackageNotFoundError:
                found[name] = None
        try:
            resolved = socket.gethostbyname(socket.gethostname())
        except OSError:  # TorchRL takes the same address then
            resolved = "127.0.0.1"
        return {"versions": found, "clock": time.time(), "resolved": resolved}

    return facts


def difference(here: Mapping[str, str | None], there: Mapping[str, str | None]) -> str | None:
    """Return how the versions of two machines differ, in one line; None if they do not."""
    differing = [name for name, own in here.items() if own != there.get(name)]
    if not differing:
        return None
    text = ", ".join(
        f"{name} {here[name]} here and {there.get(name) or 'missing'} there" for name in differing
    )
    return f"the cart's and the learner's machine have other versions: {text}; install the same ones on both"


def check_learners(
    nodes: Iterable[Mapping[str, Any]], ask: Callable[[str], Mapping[str, Any]], own_address: str
) -> list[str]:
    """Check the machines that offer LEARNER; return warnings about their clocks.

    `nodes` are Ray's; `ask` returns the facts of one by its id; `own_address` is that of this machine. Raises
    LearnerError if there is none, if one has other versions, or if TorchRL would give the other machine an
    address that it cannot reach.
    """
    here = fact_finder()()
    offering = [node for node in nodes if node["Alive"] and LEARNER in node["Resources"]]
    if not offering:
        raise LearnerError(
            f"no Ray node offers the resource {LEARNER}: on the learner's machine, start Ray with "
            + START_RAY.format(port=6379)
        )
    warnings = []
    for node in offering:
        asked = time.time()
        there = ask(node["NodeID"])
        middle = (asked + time.time()) / 2
        if text := difference(here["versions"], there["versions"]):
            raise LearnerError(text)
        if (address := node["NodeManagerAddress"]) != own_address:
            check_host_name("the learner's", there["resolved"])
            check_host_name("the cart's", here["resolved"])
        behind = middle - there["clock"]
        if abs(behind) > CLOCKS:
            warnings.append(
                f"the clock of {address} differs by {abs(behind):.0f} s from this one; set both by NTP"
            )
    return warnings


def check_host_name(whose: str, resolved: str) -> None:
    """Raise LearnerError if a machine's name stands for the machine itself, as Debian sets it up."""
    if resolved.startswith("127."):
        raise LearnerError(
            f"the host name of {whose} machine resolves to {resolved} there, and TorchRL tells the other "
            "machine that address: in /etc/hosts, give the name its address in the network"
        )
