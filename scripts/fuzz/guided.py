#!/usr/bin/env python
"""Coverage-guided fuzzing of both sides of the wire, with libFuzzer.

    pip install atheris       # libFuzzer for Python; not a dependency of this project
    scripts/fuzz/guided.py cart corpus/cart -max_total_time=300
    scripts/fuzz/guided.py host corpus/host -max_total_time=300
    coverage run --branch scripts/fuzz/guided.py --replay cart corpus/cart     # needs no atheris

An input is a list of steps for one side: raw bytes, valid frames of any type with any payload, and between
them periods with any encoder counts (cart) or calls of any method (host). Valid frames take the fuzzer past
the checksum to the state machines. libFuzzer prints what was reached (`cov`, `ft`) and the memory (`rss`);
options that begin with `-` are its own. An input that breaks a rule is saved as `crash-...`.

Rules for the cart: no exception; the motor is 0 unless the cart is armed, homing or braked; the motor is 0
or the brake's in the fourth period without a command; homing ends without frames of the host; bytes that are
not a valid frame change nothing and get no answer. Rules for the host: no exception outside `errors.py`; no
motor value other than 0 is sent unless it was requested; no count of its statistics is negative.
"""

import contextlib
import importlib
import logging
import sys
from pathlib import Path
from typing import Any

LIBRARIES = ("cartpole_rl.wire", "cartpole_rl.emulator", "cartpole_rl.plants")
fuzzer: Any = None
if "--replay" not in sys.argv:
    try:
        fuzzer = importlib.import_module("atheris")
    except ImportError:
        sys.exit("guided.py needs atheris: pip install atheris")

with fuzzer.instrument_imports(include=LIBRARIES) if fuzzer else contextlib.nullcontext():
    from cartpole_rl.emulator.firmware import LEASE_US, WATCHDOG_PERIODS, Firmware
    from cartpole_rl.plants.serial import cart as serial_cart
    from cartpole_rl.plants.serial import connection
    from cartpole_rl.plants.settings import SerialSettings
    from cartpole_rl.wire.frames import (
        END,
        LONGEST_FRAME,
        VERSION,
        FrameSplitter,
        crc16,
        decode_frame,
        open_envelope,
        stuff,
    )
    from cartpole_rl.wire.messages import FROM_CART, MESSAGES, Flags, SetMotor, Start, State

from cartpole_rl.errors import CartPoleError, FrameError  # noqa: E402 - after what is instrumented

CART_TYPES = (0x81, 0x82, 0x83, 0x84, 0x85)
MOST_STEPS = 200
LOOK_US = 4000  # between two looks of the firmware at its counts


class Steps:
    """Reads an input as numbers and bytes; past its end everything is 0."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def left(self) -> bool:
        """True while bytes are left."""
        return self._at < len(self._data)

    def take(self, count: int) -> bytes:
        """Return the next bytes, zeros past the end."""
        taken = self._data[self._at : self._at + count]
        self._at += count
        return taken.ljust(count, b"\0")

    def number(self, count: int = 1) -> int:
        """Return the next number, signed if it has more than one byte."""
        return int.from_bytes(self.take(count), "little", signed=count > 1)


def valid_frame(version: int, kind: int, sequence: int, flags: int, payload: bytes) -> bytes:
    """Return a frame with a right checksum, without its final 0x00."""
    body = bytes((version, kind, sequence, flags)) + payload
    return stuff(body + crc16(body).to_bytes(2, "little"))


class Driven:
    """A firmware, and what was accepted when; the encoder counts are those of the newest period."""

    def __init__(self, homed: bool) -> None:
        self.firmware = Firmware(lambda: 3_000)
        self.firmware.homed = homed
        self.now_us = self.heard_us = self.carts = self.poles = 0
        self.silent = 0  # periods since the newest frame that keeps the watchdog quiet

    def receive(self, stuffed: bytes) -> list[bytes]:
        """Let a frame arrive; return the answers."""
        answers = self.firmware.receive(stuffed, self.now_us)
        if self.firmware.carried_out is not None:
            self.heard_us = self.now_us
        if isinstance(self.firmware.carried_out, SetMotor | Start):
            self.silent = 0
        return answers

    def pass_period(self, cart: int, pole: int) -> None:
        """Pass a period in which the counts change by `cart` and `pole`; check the rules."""
        firmware, end_us = self.firmware, self.now_us + self.firmware.period_us
        idle = not firmware.armed and not firmware.homing
        self.carts, self.poles, self.silent = self.carts + cart, self.poles + pole, self.silent + 1
        driven = set()
        while self.now_us < end_us:
            firmware.drive(self.now_us)
            driven.add(0 if firmware._limits.brake else firmware.motor)
            self.now_us = firmware.next_due(min(end_us, self.now_us + LOOK_US))
            firmware.look(self.now_us, self.carts, self.poles)
        frames = [decode_frame(frame[:-1]) for frame in firmware.tick(end_us, self.carts, self.poles)]
        state = frames[-1].message
        assert isinstance(state, State)
        assert not idle or driven == {0}, "the motor ran while it was neither armed nor homing"
        if firmware.armed and self.silent > WATCHDOG_PERIODS:
            assert driven == {0}, "the watchdog did not stop the motor"
        if not firmware.armed and not firmware.homing and state.motor_applied:
            assert frames[-1].flags & Flags.SOFT_LIMIT, "the motor of an idle cart is not the brake's"
        if firmware.homing:
            assert self.now_us - self.heard_us <= LEASE_US, "homing goes on without a host"


def cart(data: bytes) -> None:
    """Feed one input to a firmware."""
    steps, splitter = Steps(data), FrameSplitter()
    driven = Driven(bool(steps.number() & 1))
    firmware = driven.firmware
    for _ in range(MOST_STEPS):
        if not steps.left:
            return
        match steps.number() % 4:
            case 0:
                for stuffed in splitter.feed(steps.take(steps.number() % 80)):
                    before = (firmware.armed, firmware.homing, firmware.fault)
                    answers = driven.receive(stuffed)
                    if not opens(stuffed):
                        assert not answers
                        assert before == (firmware.armed, firmware.homing, firmware.fault)
                assert len(splitter.pending) <= LONGEST_FRAME
            case 1:
                kinds = tuple(kind for kind in MESSAGES if not kind & FROM_CART)
                kind, size = kinds[steps.number() % len(kinds)], (0, 0, 6, 6, 4, 4, 1, 3)[steps.number() % 8]
                payload = steps.take(size)
                if kind == SetMotor.TYPE and size == 6:  # an answer to one of the newest states
                    tick = (firmware._ticks - payload[-1] % 4) % 2**32
                    payload = payload[:2] + tick.to_bytes(4, "little")
                for answer in driven.receive(valid_frame(VERSION, kind, steps.number(), 0, payload)):
                    decode_frame(answer[:-1])
            case 2:
                version, kind, size = steps.number(), steps.number(), steps.number() % 12
                driven.receive(valid_frame(version, kind, steps.number(), steps.number(), steps.take(size)))
            case _:
                periods, step_cart, step_pole = 1 + steps.number() % 32, steps.number(2), steps.number(2)
                for _ in range(periods):
                    driven.pass_period(step_cart // 64, step_pole // 16)


def opens(stuffed: bytes) -> bool:
    """Return whether the checksum of a run of bytes is right."""
    try:
        open_envelope(stuffed)
    except FrameError:
        return False
    return True


class Wire:
    """A port in memory; its cart answers each write with the next bytes and frames of the input."""

    port = "memory"

    def __init__(self, steps: Steps) -> None:
        self._steps, self._inward = steps, b""
        self._splitter = FrameSplitter()
        self.requested = 0  # the motor value that may be sent
        self._tick = 0

    @property
    def in_waiting(self) -> int:
        """Number of bytes that can be read."""
        return len(self._inward)

    def read(self, count: int) -> bytes:
        """Return up to `count` bytes that have arrived."""
        data, self._inward = self._inward[:count], self._inward[count:]
        return data

    def write(self, data: bytes) -> None:
        """Check what the host sends, and answer it."""
        sequence = kind = 0
        for stuffed in self._splitter.feed(data):
            frame = decode_frame(stuffed)
            sequence, kind = frame.sequence, frame.message.TYPE
            if isinstance(frame.message, SetMotor):
                assert frame.message.motor in (0, self.requested), "the motor value was not requested"
        for _ in range(self._steps.number() % 4):
            self._inward += self._answer(sequence, kind)

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def _answer(self, sequence: int, kind: int) -> bytes:
        steps = self._steps
        match steps.number() % 6:
            case 0:
                return steps.take(steps.number() % 40)
            case 1:
                type_, size = CART_TYPES[steps.number() % 5], steps.number() % 32
                return valid_frame(VERSION, type_, steps.number(), steps.number(), steps.take(size)) + END
            case 2:
                info = bytes((2, 0, 0)) + (4096).to_bytes(2, "little") + (22749).to_bytes(4, "little")
                return valid_frame(VERSION, 0x81, 0, 0, info + steps.take(18)) + END
            case 3:
                acknowledged = kind if steps.number() % 4 else steps.number() % 8
                return valid_frame(VERSION, 0x83, 0, 0, bytes((sequence, acknowledged))) + END
            case 4:
                refused = kind if steps.number() % 4 else steps.number() % 8
                payload = bytes((sequence, refused, steps.number() % 12))
                return valid_frame(VERSION, 0x84, 0, 0, payload) + END
            case _:
                self._tick = (self._tick + steps.number() % 40 - 4) % 2**32
                counts = steps.take(8) + (0).to_bytes(2, "little") + bytes((sequence,))
                times = self._tick.to_bytes(4, "little") + (self._tick * 20_000 % 2**32).to_bytes(4, "little")
                state = times + counts + bytes((steps.number() & 1, 0)) + steps.take(2)
                return valid_frame(VERSION, 0x82, 0, steps.number() & int(~Flags(0)), state) + END


def host(data: bytes) -> None:
    """Feed one input to a SerialCart whose timeouts are close to 0."""
    connection.UNACKNOWLEDGED_PERIODS = 1e-3
    connection.LISTENING_PERIODS = 0
    steps = Steps(data)
    wire = Wire(steps)
    serial_cart.open_port = lambda *given: wire
    quick = {"timeout": 2e-4, "connect_timeout": 2e-4, "answer_timeout": 1e-4, "home_timeout": 2e-4}
    settings = SerialSettings(port="memory").model_copy(update={**quick, "retries": 1, "nudge_after": 5e-5})
    driven = serial_cart.SerialCart(settings)
    for _ in range(MOST_STEPS):
        if not steps.left:
            break
        with contextlib.suppress(CartPoleError):
            driven.open()  # again, if the cart did not answer
            call(driven, wire, steps)
        seen = driven.statistics
        assert min(seen.lost_frames, seen.late_ticks, seen.overtaken_frames, seen.repeated_frames) >= 0
    driven.close()


def call(driven: "serial_cart.SerialCart", wire: Wire, steps: Steps) -> None:
    """Call one method of the host."""
    match steps.number() % 11:
        case 0:
            driven.start()
        case 1 | 2:
            wire.requested = steps.number(2)
            limit = max(0, driven.information.motor_limit)
            wire.requested = max(-limit, min(limit, wire.requested))
            driven.set_motor(wire.requested)
        case 3 | 4:
            driven.get_state()
        case 5:
            driven.home()
        case 6:
            driven.clear_fault()
        case 7:
            driven.start_policy()
        case 8:
            driven.follow_policy()
        case 9:
            driven.check_policy(steps.number(4) % 2**32)
        case _:
            driven.set_period(20_000)


SIDES = {"cart": cart, "host": host}


def main() -> None:
    """Fuzz, or replay a corpus."""
    words = [word for word in sys.argv[1:] if word != "--replay"]
    if not words or words[0] not in SIDES:
        sys.exit(f"give the side first: {' or '.join(SIDES)}")
    side, rest = SIDES[words[0]], words[1:]
    logging.disable()  # every input ends with a cart that may not answer
    if fuzzer:
        for folder in rest:
            if not folder.startswith("-"):
                Path(folder).mkdir(parents=True, exist_ok=True)
        fuzzer.Setup([sys.argv[0], *rest], side)
        fuzzer.Fuzz()
    for folder in rest:
        files = sorted(path for path in Path(folder).rglob("*") if path.is_file())
        for path in files:
            side(path.read_bytes())
        print(f"{len(files)} inputs of {folder} broke no rule")


if __name__ == "__main__":
    main()
