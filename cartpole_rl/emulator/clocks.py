"""The two clocks of the emulated cart. Both run until they are interrupted, or the cable is pulled."""

import time
from collections import deque

from cartpole_rl.emulator.device import CartDevice
from cartpole_rl.emulator.link import Channel
from cartpole_rl.scheduling import take_precedence


def run_lockstep(cart: CartDevice, channel: Channel) -> None:
    """One period for each frame from the host, lost and damaged ones included; no clock of any kind.

    Where a STATE is lost, late or damaged on its way, further periods pass until one gets through, so a host
    that sends a frame and waits for a STATE never waits in vain. While homing, the cart runs on by itself.
    """
    waiting: deque[bytes | None] = deque()
    while not cart.unplugged:
        homing = cart.firmware.homing
        if not waiting:
            waiting.extend(channel.receive(0) if homing else channel.receive())
        if waiting:
            take(cart, channel, waiting.popleft(), cart.now_us)
        elif not homing:
            continue
        while not pass_period(cart, channel, cart.period_end_us):
            pass


def run_real(cart: CartDevice, channel: Channel) -> None:
    """A period every 20 ms of the monotonic clock, on deadlines that do not drift.

    Commands are stamped as they arrive; the physics of a period is worked out at its end, when all are known.
    """
    take_precedence()  # a cart is late for nobody
    boot = time.monotonic()
    while not cart.unplugged:
        end_us = cart.period_end_us
        while (left := boot + end_us / 1e6 - time.monotonic()) > 0:
            for frame in channel.receive(left):
                arrival_us = int((time.monotonic() - boot) * 1e6)
                take(cart, channel, frame, min(max(arrival_us, cart.now_us), end_us))
        pass_period(cart, channel, end_us)


def pass_period(cart: CartDevice, channel: Channel, end_us: int) -> bool:
    """Let a period pass and send what it brings, unless the cable was pulled in it.

    Returns whether nothing more is owed to the host: its STATE left undamaged, or the cable is gone.
    """
    frames = cart.pass_period(end_us)
    return cart.unplugged or send_all(channel, frames)


def take(cart: CartDevice, channel: Channel, frame: bytes | None, now_us: int) -> None:
    """Give the cart a frame that was not lost, and send its answer."""
    if frame is not None:
        send_all(channel, cart.receive(frame, now_us))


def send_all(channel: Channel, frames: list[bytes]) -> bool:
    """Send frames in order; returns whether the last one left undamaged."""
    return [channel.send(frame) for frame in frames][-1:] == [True]
