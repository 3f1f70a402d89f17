"""The emulated cart as a whole: firmware, physics, encoders and a person's hand, period by period.

`run` makes it a process with a port that a host can open, and one of two clocks.
"""

import json
import math
import os
import random
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

from cartpole_rl.emulator.c_firmware import CFirmware
from cartpole_rl.emulator.firmware import BANNER, Firmware
from cartpole_rl.emulator.guards import lever_um
from cartpole_rl.emulator.link import Channel, open_link
from cartpole_rl.emulator.physics import CartPhysics
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.scheduling import take_precedence
from cartpole_rl.signals import until_stopped
from cartpole_rl.wire.messages import Message

BOOT_HANGING = 0.3  # largest distance from the middle with boot=hanging, share of the half length
BOOT_ANYWHERE = 0.99  # the same with boot=anywhere
FASTEST_BOOT = 8.0  # rad/s, of the pole with boot=anywhere
STANDS_WITHIN = math.radians(5)  # of upright, the pole stands
STANDS_US = 2_000_000  # that it has to stand before a hand knocks it
HAND_ERROR = 0.03  # rad, largest error of a hand that holds the pole upright
LOOK_US = 1000  # between two looks of the firmware at the cart's position
HOMING_US = 100_000  # that pass for each frame while the cart homes; the host asks as often


class CartDevice:
    """A cart that was just switched on, at a place that `boot` decides. Time passes only in `pass_period`.

    Times are whole microseconds since the start; the firmware counts from its own boot.
    """

    def __init__(self, settings: EmulatorSettings) -> None:
        """Raises EmulatorError if MuJoCo is not installed or the C firmware cannot be compiled.

        Raises OSError if the journal cannot be created.
        """
        self._settings = settings
        self._hardware = settings.hardware or nominal_hardware()
        self._metres, self._radians = self._hardware.encoders.resolution
        self.physics = CartPhysics(settings)
        self._journal = Journal(settings.journal) if settings.journal else None
        self.physics.on_contact = self._touch
        self._latencies = random.Random(f"latency {settings.seed}")
        self._people = random.Random(f"people {settings.seed}")
        self._held: float | None = None  # rad, the angle at which the hand holds the pole
        self._standing_us = 0  # for how long the pole has stood since START
        self._knocked = False  # since START
        self._knock = settings.knock  # rad/s of the next knock; to the right and left in turn
        self.now_us = 0
        self._looked_us = 0
        self._place_cart()
        self._reset_us = microseconds(settings.reset_at)
        self._unplug_us = microseconds(settings.unplug_at)
        self._stuck_us = None if settings.stuck_encoder == "none" else microseconds(settings.stuck_at)
        self._stuck_count: int | None = None
        self._boot_firmware()

    def receive(self, stuffed: bytes, now_us: int) -> list[bytes]:
        """Give the cart a frame that arrived at `now_us`; return the answer."""
        answer = self.firmware.receive(stuffed, now_us - self._booted_us)
        if self._journal and self.firmware.carried_out:
            self._journal.took(now_us, self.firmware.carried_out)
        return answer

    @property
    def clock_rate(self) -> float:
        """The seconds that the firmware's clock passes in a second."""
        return self._settings.clock_rate

    @property
    def unplugged(self) -> bool:
        """True once the cable has been pulled."""
        return self._unplug_us is not None and self.now_us >= self._unplug_us

    @property
    def period_end_us(self) -> int:
        """The end of the period that begins now."""
        return self.now_us + self.firmware.period_us

    def pass_period(self, end_us: int) -> list[bytes]:
        """Pass the time until `end_us` as one period; return the frames sent at its end, STATE last.

        A reset that is due happens first; its banner, which ends in 0x00, precedes the frames.
        """
        banner = []
        if self._reset_us is not None and self.now_us >= self._reset_us:
            self._reset_us = None
            self._boot_firmware()
            banner = [BANNER]
        self._move_hand()
        start_us = self.now_us
        while self.now_us < end_us:
            self.firmware.drive(self.now_us - self._booted_us)
            self._note_motor()
            until_us = self._booted_us + self.firmware.next_due(end_us - self._booted_us)
            self._move(until_us)
        if self._held is not None:
            self.physics.place_pole(self._held)
        frames = self.firmware.tick(end_us - self._booted_us, *self._counts())
        self._note_motor()
        self._move_hand()
        self._maybe_knock(end_us - start_us)
        return banner + frames

    def _move(self, until_us: int) -> None:
        """Let the cart move until `until_us`, while the firmware looks at its position."""
        start_us, rate, firmware = self.now_us, self._settings.clock_rate, self.firmware
        motor = firmware.motor

        def look(seconds: float) -> int:
            nonlocal motor
            self.now_us = start_us + round(seconds * rate * 1e6)
            if self.now_us - self._looked_us >= LOOK_US:
                self._looked_us = self.now_us
                firmware.switches = self.physics.switches
                firmware.look(self.now_us - self._booted_us, *self._counts())
                self._note_motor()
                motor = firmware.motor
            return motor

        self.physics.advance(motor, (until_us - start_us) / 1e6 / rate, look)
        self.now_us = until_us

    def _note_motor(self) -> None:
        if self._journal:
            self._journal.in_force(self.now_us, self.firmware.motor)

    def _touch(self, speed: float) -> None:
        if self._journal:
            self._journal.touched(self.now_us, speed)

    def _place_cart(self) -> None:
        settings, draw = self._settings, self._people.uniform
        if settings.boot == "hanging":
            self.physics.place(settings.track_half_length * draw(-BOOT_HANGING, BOOT_HANGING), math.pi)
            return
        x = settings.track_half_length * draw(-BOOT_ANYWHERE, BOOT_ANYWHERE)
        self.physics.place(x, draw(-math.pi, math.pi), draw(-FASTEST_BOOT, FASTEST_BOOT))

    def _boot_firmware(self) -> None:
        """Start the firmware, whose encoders count from 0 at this moment."""
        self._booted_us = self.now_us
        self._boot = (0, 0)
        self._boot = self._counts()
        self.firmware = self._new_firmware()

    def _new_firmware(self) -> Firmware | CFirmware:
        """Return the firmware that the settings choose, just booted."""
        cart, rig = self._settings, self._hardware
        zero_error = round(cart.angle_offset / self._radians)
        lever = lever_um(cart.model_dump())
        if cart.firmware == "c":
            return CFirmware(self._latency_us, zero_error, lever, cart.policy, 2 * cart.pole_com, rig)
        return Firmware(self._latency_us, zero_error, lever, rig)

    def _counts(self) -> tuple[int, int]:
        """Return the raw counts of cart and pole since boot."""
        cart, pole = self._disc_counts()
        if self._stuck_us is not None and self.now_us >= self._stuck_us:
            of_cart = self._settings.stuck_encoder == "cart"
            if self._stuck_count is None:
                self._stuck_count = cart if of_cart else pole
            cart, pole = (self._stuck_count, pole) if of_cart else (cart, self._stuck_count)
        return cart - self._boot[0], pole - self._boot[1]

    def _disc_counts(self) -> tuple[int, int]:
        """Return the counts of the encoder discs.

        The position of the pole's disc includes the fraction of `angle_offset` that is below a count; the
        firmware's zero, a whole number, includes the rest.
        """
        x, angle = self.physics.position
        angle += self._settings.angle_offset
        return math.floor(x / self._metres), math.floor(angle / self._radians + 0.5)

    def _latency_us(self) -> int:
        jitter = self._settings.latency_jitter
        return round(max(0.0, self._settings.latency + self._latencies.uniform(-jitter, jitter)) * 1e6)

    def _maybe_knock(self, period_us: int) -> None:
        """Knock a pole that has stood long enough, once after each START."""
        if not self._knock or not self.firmware.armed:
            self._standing_us, self._knocked = 0, False
            return
        physics = self.physics
        stands = abs(math.remainder(physics.angle, math.tau)) < STANDS_WITHIN
        self._standing_us = self._standing_us + period_us if stands else 0
        if self._standing_us >= STANDS_US and not self._knocked:
            physics.place_pole(physics.angle, physics.angle_dot + self._knock)
            self._knock, self._knocked = -self._knock, True

    def _move_hand(self) -> None:
        """With start=upright: hold the pole up while the cart is homed and disarmed, else let go."""
        if self._settings.start != "upright":
            return
        firmware = self.firmware
        holds = firmware.homed and not firmware.armed
        if holds and self._held is None:
            self._held = nearest_upright(self.physics.angle) + self._people.uniform(-HAND_ERROR, HAND_ERROR)
            self.physics.place_pole(self._held)
        elif not holds and self._held is not None:
            if firmware.homing:
                self.physics.place_pole(nearest_upright(self.physics.angle) + math.pi)
            self._held = None


class Journal:
    """The cart's own record: commands carried out, motor values in force, end stops touched.

    One JSON line for each event, with `us` in microseconds since the emulator's start:
    {"us": 40210, "took": "SET_MOTOR", "motor": -200, "tick": 2}; {"us": 43310, "in_force": -200};
    {"us": 61310, "touched": 0.08}, in m/s.
    Events are written at once, to a new file. Raises FileExistsError: it overwrites no file.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("x", buffering=1, encoding="utf-8")
        self._motor = 0

    def took(self, us: int, message: Message) -> None:
        """Record a command that the cart carried out."""
        self._write(us, took=message.TYPE.name, **vars(message))

    def touched(self, us: int, speed: float) -> None:
        """Record that the cart has touched an end stop at `speed` m/s."""
        self._write(us, touched=round(speed, 4))

    def in_force(self, us: int, motor: int) -> None:
        """Record the motor value in force if it has changed."""
        if motor != self._motor:
            self._motor = motor
            self._write(us, in_force=motor)

    def _write(self, us: int, **event: Any) -> None:
        self._file.write(json.dumps({"us": us, **event}) + "\n")


def nearest_upright(angle: float) -> float:
    """Return the upright angle to which a hand lifts the pole; a pole near pi goes to 0, not to two pi."""
    return 2 * math.pi * round((angle - 0.5) / (2 * math.pi))


def microseconds(seconds: float | None) -> int | None:
    """Return whole microseconds; None, which means never, stays None."""
    return None if seconds is None else round(seconds * 1e6)


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
