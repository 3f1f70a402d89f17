"""The emulated cart as a process with a port that a host can open."""

import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from cartpole_rl.emulator.clocks import run_lockstep, run_real
from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.emulator.link import Channel, open_link
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.signals import ending_signals


def run(settings: EmulatorSettings) -> None:
    """Print one JSON line with `port` and `pid`, and emulate until SIGINT, SIGTERM, SIGHUP or `unplug_at`.

    Main thread only. Raises EmulatorError if MuJoCo is missing, or pseudo-terminals for `port` pty.
    """
    cart = CartDevice(settings)
    with until_stopped(), open_link(settings.port) as link:
        print(json.dumps({"port": link.port, "pid": os.getpid()}), flush=True)
        if sys.stderr.isatty():  # a person, not a program that reads the line
            print(f"next, in another terminal: cartpole-preflight plant.port={link.port}", file=sys.stderr)
        clock = run_lockstep if settings.clock == "lockstep" else run_real
        clock(cart, Channel(link, settings))
        print(f"the cable was pulled after {settings.unplug_at:g} s (unplug_at)", file=sys.stderr)


@contextmanager
def until_stopped() -> Iterator[None]:
    """End the block without an error on SIGINT, SIGTERM or SIGHUP."""

    def interrupt(signum: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, *ending_signals())}
    try:
        yield
    except KeyboardInterrupt:
        return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
