#!/usr/bin/env python
"""Noise and damaged frames, in bulk, into both sides of the wire.

    scripts/fuzz/wire.py [--noise 10000000] [--frames 1000000] [--seed 0]

Random bytes, then sound frames with a few bytes changed, put in, taken out or doubled, half of them on the
wire and half before they are stuffed, so that the checksum alone can tell, go through the frame splitter
into the host's decoder and, separately, into a homed and disarmed firmware. Prints counts, the longest run
that a splitter kept, and the peak of the process's memory. Exit status 1 if the cart moved, armed or homed,
if it answered a frame that the checksum refuses, or if a splitter kept more than it may; any exception but
FrameError ends the run with its traceback.

A checksum of 16 bits lets up to one well-stuffed frame in 65536 through (*passed*). Such a frame is sound
to any reader; one that would start or home the cart is counted (*kept back*) and not given to it. Nor is a
run that is undamaged after all, as when a zero was put before it (*whole*).
"""

import argparse
import random
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator

from cartpole_rl.emulator.firmware import Firmware
from cartpole_rl.errors import FrameError
from cartpole_rl.wire import (
    Ack,
    ClearFault,
    FaultReport,
    FrameSplitter,
    Hello,
    Home,
    Info,
    Message,
    Nack,
    SetMotor,
    SetPeriod,
    Start,
    State,
    Stop,
    cobs,
    decode_frame,
    encode_frame,
)
from cartpole_rl.wire.frames import END, LONGEST_FRAME, Envelope, open_envelope

CHUNK = 4096  # bytes; as much as one read of a port gives
TICK_EVERY = 64  # runs of bytes between two periods of the firmware
FROM_HOST: list[Message] = [Hello(), Start(), Stop(), SetMotor(-200), Home(), ClearFault(), SetPeriod(20_000)]
FROM_CART: list[Message] = [
    Info(1, 0, 0, 4096, 22749, 255, 16704, 17539, 20_000),
    State(1169, 23_380_000, 43, 2051, -200, 4, 0, 20),
    Ack(2, 5),
    Nack(6, 4, 5),
    FaultReport(1, 1200),
]


def noise(count: int, dice: random.Random) -> Iterator[bytes]:
    """`count` random bytes, in chunks."""
    for start in range(0, count, CHUNK):
        yield dice.randbytes(min(CHUNK, count - start))


def damaged(count: int, whole: list[bytes], dice: random.Random) -> Iterator[bytes]:
    """`count` frames after one to four changes each, with their ending 0x00."""
    for number in range(count):
        stuffed = number % 2 == 0
        frame = bytearray(dice.choice(whole))
        if not stuffed:
            frame = bytearray(cobs.decode(bytes(frame)))
        for _ in range(dice.randint(1, 4)):
            at, length = dice.randrange(len(frame) + 1), dice.randint(0, 3)
            new = (
                bytes(frame[at : at + length]) * 2
                if dice.random() < 0.2
                else dice.randbytes(dice.randint(0, 3))
            )
            frame[at : at + length] = new
        yield (bytes(frame) if stuffed else cobs.encode(bytes(frame))) + END


class Side:
    """One reader of the wire: its splitter, its counts, what was wrong."""

    def __init__(self, whole: list[bytes]) -> None:
        self._whole = set(whole)
        self._splitter = FrameSplitter()
        self.counts = Counter({"passed": 0, "kept back": 0})
        self.longest = 0
        self.wrong: list[str] = []

    def feed(self, stream: Iterator[bytes]) -> None:
        """Take all chunks of a stream."""
        for chunk in stream:
            self.counts["bytes"] += len(chunk)
            for stuffed in self._splitter.feed(chunk):
                self.counts["runs"] += 1
                if stuffed in self._whole:
                    self.counts["whole"] += 1
                else:
                    self.take(stuffed)
            self.longest = max(self.longest, len(self._splitter._pending))
        self.counts["overlong"] = self._splitter.overlong
        if self.longest > LONGEST_FRAME:
            self.wrong.append(f"a splitter kept {self.longest} bytes")

    def take(self, stuffed: bytes) -> None:
        """Take one run of bytes."""
        raise NotImplementedError


class HostSide(Side):
    """The host's decoder."""

    def take(self, stuffed: bytes) -> None:
        """Decode it, or have it refused."""
        try:
            open_envelope(stuffed)
            self.counts["passed"] += 1
            decode_frame(stuffed)
        except FrameError:
            self.counts["refused"] += 1


class CartSide(Side):
    """The firmware of a cart that is homed and disarmed, and ticks now and then."""

    def __init__(self, whole: list[bytes]) -> None:
        super().__init__(whole)
        self._firmware = Firmware(lambda: 3_000)
        self._firmware.homed = True
        self._now_us = 0

    def take(self, stuffed: bytes) -> None:
        """Give it to the firmware, and look whether the cart keeps still."""
        envelope = opened(stuffed)
        if envelope is not None:
            self.counts["passed"] += 1
            if envelope.kind in (Start.TYPE, Home.TYPE):
                self.counts["kept back"] += 1
                return
        answers = self._firmware.receive(stuffed, self._now_us)
        self.counts["answers"] += len(answers)
        if envelope is None:
            self.counts["refused"] += 1
            if answers:
                self.wrong.append(f"{stuffed.hex(' ')} was answered")
        if self._firmware.armed or self._firmware.homing:
            self.wrong.append(f"{stuffed.hex(' ')} set the cart in motion")
            self._firmware.armed = False
        if self.counts["runs"] % TICK_EVERY == 0:
            self._tick()

    def _tick(self) -> None:
        end_us = self._now_us + self._firmware.period_us
        motors = {value for _, value in self._firmware.drive(self._now_us, end_us)}
        state = decode_frame(self._firmware.tick(end_us, 0, 0)[-1][:-1]).message
        self._now_us = end_us
        self.counts["periods"] += 1
        if motors != {0} or not isinstance(state, State) or state.motor_applied:
            self.wrong.append(f"the motor ran in period {self.counts['periods']}")


def opened(stuffed: bytes) -> Envelope | None:
    """What the checksum lets through of a run of bytes."""
    try:
        return open_envelope(stuffed)
    except FrameError:
        return None


def peak_megabytes() -> float:
    """The process's largest resident memory so far; ru_maxrss counts KiB on Linux, bytes on macOS."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def frames_of(messages: list[Message]) -> list[bytes]:
    """One sound frame for each message and a few sequences."""
    return [encode_frame(message, sequence)[:-1] for message in messages for sequence in (0, 1, 3, 200)]


def main() -> int:
    """Run both kinds of bytes into both sides; returns the exit status."""
    parser = argparse.ArgumentParser(description="Noise and damaged frames into both sides of the wire.")
    parser.add_argument("--noise", type=int, default=10_000_000, help="random bytes to each side")
    parser.add_argument("--frames", type=int, default=1_000_000, help="damaged frames to each side")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    from_cart, from_host = frames_of(FROM_CART), frames_of(FROM_HOST)
    wrong: list[str] = []
    print(f"{peak_megabytes():.1f} MiB before")
    for name, kind, whole in (("host", HostSide, from_cart), ("cart", CartSide, from_host)):
        for what in ("noise", "frames"):
            dice, begun, side = random.Random(f"{what} {options.seed}"), time.perf_counter(), kind(whole)
            side.feed(noise(options.noise, dice) if what == "noise" else damaged(options.frames, whole, dice))
            counts = ", ".join(f"{count} {item}" for item, count in side.counts.items())
            print(
                f"{what} to the {name}: {counts}; splitter at most {side.longest} bytes; "
                f"peak {peak_megabytes():.1f} MiB; {time.perf_counter() - begun:.0f} s"
            )
            wrong += side.wrong
    print("\n".join(wrong) or "nothing wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
