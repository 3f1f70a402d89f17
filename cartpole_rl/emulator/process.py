"""The emulated cart as a process with a port that a host can open, and its two clocks."""

import json
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.emulator.link import Channel, open_link
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.scheduling import take_precedence
from cartpole_rl.signals import RaiseOnce, ending_signals

HOMING_US = 100_000  # that pass for each frame while the cart homes; the host asks as often


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
    """End the block without an error on SIGINT, SIGTERM or SIGHUP; a second does not end its unwinding."""
    interrupt = RaiseOnce(lambda number: KeyboardInterrupt())
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, *ending_signals())}
    try:
        yield
    except KeyboardInterrupt:
        return
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_lockstep(cart: CartDevice, channel: Channel) -> None:
    """Pass one period for each frame from the host, including lost and damaged ones, without a clock.

    If a STATE is lost, late or damaged, further periods pass until one arrives undamaged. So a host that
    sends a frame always receives a STATE. While the cart homes, further periods pass, `HOMING_US` in all.
    """
    waiting: deque[bytes | None] = deque()
    while not cart.unplugged:
        if not waiting:
            waiting.extend(channel.receive())
            continue
        handle(cart, channel, waiting.popleft(), cart.now_us)
        end_us = cart.now_us + HOMING_US
        while not pass_period(cart, channel, cart.period_end_us) or (
            cart.firmware.homing and cart.now_us < end_us
        ):
            pass


def run_real(cart: CartDevice, channel: Channel) -> None:
    """Pass one period every 20 ms of the monotonic clock, with deadlines that do not drift.

    Commands get a time stamp on arrival; the physics of a period is computed at its end. If this process was
    held up, the period lasts until now, as on a board, instead of many periods in a row. What waited
    meanwhile counts as having arrived in time.
    """
    take_precedence()  # a real cart would not be late either
    boot, rate = time.monotonic(), cart.clock_rate

    def now_us() -> int:
        return int((time.monotonic() - boot) * rate * 1e6)

    while not cart.unplugged:
        end_us, left_us = cart.period_end_us, 1
        while left_us > 0:
            left_us = end_us - now_us()
            for frame in channel.receive(max(0, left_us) / 1e6 / rate):
                handle(cart, channel, frame, min(max(now_us(), cart.now_us), end_us))
        late_us = now_us() - end_us
        pass_period(cart, channel, end_us + late_us if late_us > cart.firmware.period_us // 2 else end_us)


def pass_period(cart: CartDevice, channel: Channel, end_us: int) -> bool:
    """Pass a period and send its frames, unless the cable was pulled during it.

    Returns whether the STATE was sent undamaged or the cable is pulled.
    """
    frames = cart.pass_period(end_us)
    return cart.unplugged or send_all(channel, frames)


def handle(cart: CartDevice, channel: Channel, frame: bytes | None, now_us: int) -> None:
    """Give the cart a frame, unless it was lost (None), and send the answer."""
    if frame is not None:
        send_all(channel, cart.receive(frame, now_us))


def send_all(channel: Channel, frames: list[bytes]) -> bool:
    """Send frames in order; return whether the last one was sent undamaged."""
    return [channel.send(frame) for frame in frames][-1:] == [True]
