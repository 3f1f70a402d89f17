"""Two machines on one: Linux network namespaces, and the cable between them, which can be slow or cut.

The cable is a process that passes packets between two TUN devices, late or not at all. It serves kernels
without `tc netem` too. A cut drops packets silently, as a dead switch does: no connection is told of it.
Everything here needs root.
"""

import ctypes
import fcntl
import heapq
import multiprocessing
import os
import select
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

TUNSETIFF, TUN_WITHOUT_HEADER = 0x400454CA, 0x1001  # IFF_TUN | IFF_NO_PI
NEW_NETWORK = 0x40000000  # CLONE_NEWNET
DEVICE = b"cable"
LARGEST_PACKET = 65536


@dataclass(frozen=True)
class Machine:
    """One of the two: a network namespace with one address."""

    name: str
    address: str

    def command(self, *words: str | Path) -> list[str]:
        """Return the command that runs `words` on this machine."""
        return ["ip", "netns", "exec", self.name, *map(str, words)]


class Cable:
    """The cable between two machines: `set` changes its delay and whether it is cut."""

    def __init__(self, ends: tuple[int, int]) -> None:
        context = multiprocessing.get_context("fork")  # the ends are open files
        self._delay = context.Value("d", 0.0)  # s, each way
        self._cut = context.Value("b", False)
        self._process = context.Process(target=_pass_on, args=(ends, self._delay, self._cut), daemon=True)
        self._process.start()

    def set(self, delay: float = 0.0, cut: bool = False) -> None:
        """Delay each packet by `delay` s, or drop all."""
        self._delay.value, self._cut.value = delay, cut

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()


@contextmanager
def two_machines(prefix: str) -> Iterator[tuple[Machine, Machine, Cable]]:
    """Make two machines and their cable; remove them at the end."""
    machines = Machine(f"{prefix}-learner", "10.77.0.1"), Machine(f"{prefix}-cart", "10.77.0.2")
    cable = None
    try:
        ends = tuple(_make(machine) for machine in machines)
        cable = Cable((ends[0], ends[1]))
        yield (*machines, cable)
    finally:
        if cable is not None:
            cable.close()
        for machine in machines:
            _remove(machine)


def _make(machine: Machine) -> int:
    """Make a machine, and return its end of the cable as an open file."""
    subprocess.run(["ip", "netns", "add", machine.name], check=True)
    end = _tun_in(machine.name)
    for words in (
        ("link", "set", "lo", "up"),
        ("addr", "add", f"{machine.address}/24", "dev", DEVICE.decode()),
        ("link", "set", DEVICE.decode(), "txqueuelen", "5000", "up"),
    ):
        subprocess.run(machine.command("ip", *words), check=True)
    return end


def _remove(machine: Machine) -> None:
    subprocess.run(["ip", "netns", "delete", machine.name], check=False)


def _tun_in(namespace: str) -> int:
    """Return an open TUN device in a namespace; the calling process stays in its own."""
    opened: list[int] = []

    def open_there() -> None:  # a thread has its own namespace
        with Path("/run/netns", namespace).open() as file:
            if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), NEW_NETWORK):
                raise OSError(ctypes.get_errno(), "setns")
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", DEVICE, TUN_WITHOUT_HEADER))
        opened.append(device)

    thread = threading.Thread(target=open_there)
    thread.start()
    thread.join()
    return opened[0]


def _pass_on(ends: tuple[int, int], delay: "ctypes.c_double", cut: "ctypes.c_bool") -> None:
    """Pass packets from one end to the other."""
    other = {ends[0]: ends[1], ends[1]: ends[0]}
    due: list[tuple[float, int, int, bytes]] = []  # time, number, end, packet
    number = 0
    while True:
        wait = max(0.0, due[0][0] - time.monotonic()) if due else 0.5
        for end in select.select(ends, [], [], wait)[0]:
            packet = os.read(end, LARGEST_PACKET)
            if not cut.value:
                number += 1
                heapq.heappush(due, (time.monotonic() + delay.value, number, other[end], packet))
        while due and due[0][0] <= time.monotonic():
            _, _, end, packet = heapq.heappop(due)
            if not cut.value:
                os.write(end, packet)
