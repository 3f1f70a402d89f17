#!/usr/bin/env python
"""Do noise and damaged frames leave both sides of the wire unharmed?

    scripts/fuzz/wire.py --noise 10000000 --frames 1000000 --seed 0

Feeds random bytes, then damaged frames, through the frame splitter into the host's decoder and, separately,
into a homed and disarmed firmware. A damaged frame is a valid one with a few bytes changed, inserted,
deleted or doubled; half of the frames are damaged on the wire, half before they are stuffed, so that only
the checksum can detect it. Prints counts, the largest number of bytes that a splitter kept, and the peak
memory. Exit status 1 if the cart moved, armed or homed, if it answered a frame whose checksum is wrong, or
if a splitter kept too many bytes. An exception other than FrameError ends the run with its traceback.

A checksum of 16 bits passes about one of 65536 well-stuffed random frames (*passed*). Such a frame is valid
to any reader; one that would start or home the cart is counted (*withheld*) but not given to it. A run of
bytes that is undamaged after all, for example when a zero was inserted before it, is not given to it either
(*whole*).
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
from cartpole_rl.wire.frames import (
    END,
    LONGEST_FRAME,
    Envelope,
    FrameSplitter,
    decode_frame,
    encode_frame,
    open_envelope,
    stuff,
    unstuff,
)
from cartpole_rl.wire.messages import (
    Ack,
    ClearFault,
    FaultReport,
    Hello,
    Home,
    Info,
    Message,
    Nack,
    SetMotor,
    SetPeriod,
    Start,
    StartPolicy,
    State,
    Stop,
)

CHUNK = 4096  # bytes, as one read of a port returns
TICK_EVERY = 64  # runs of bytes between two periods of the firmware
FROM_HOST: list[Message] = [
    Hello(),
    Start(),
    Stop(),
    SetMotor(-200, 1168),
    Home(),
    ClearFault(),
    SetPeriod(20_000),
    StartPolicy(),
]
FROM_CART: list[Message] = [
    Info(2, 0, 0, 4096, 22749, 255, 16704, 17539, 20_000, 0),
    State(1169, 23_380_000, 43, 2051, -200, 4, 0, 20),
    Ack(2, 5),
    Nack(6, 4, 5),
    FaultReport(1, 1200),
]


def noise(count: int, dice: random.Random) -> Iterator[bytes]:
    """Yield `count` random bytes in chunks."""
    for start in range(0, count, CHUNK):
        yield dice.randbytes(min(CHUNK, count - start))


def damaged(count: int, whole: list[bytes], dice: random.Random) -> Iterator[bytes]:
    """Yield `count` frames with one to four changes each, including the final 0x00."""
    for number in range(count):
        stuffed = number % 2 == 0
        frame = bytearray(dice.choice(whole))
        if not stuffed:
            frame = bytearray(unstuff(bytes(frame)))
        for _ in range(dice.randint(1, 4)):
            at, length = dice.randrange(len(frame) + 1), dice.randint(0, 3)
            new = (
                bytes(frame[at : at + length]) * 2
                if dice.random() < 0.2
                else dice.randbytes(dice.randint(0, 3))
            )
            frame[at : at + length] = new
        yield (bytes(frame) if stuffed else stuff(bytes(frame))) + END


class Side:
    """One side of the wire: its splitter, its counts and its complaints."""

    def __init__(self, whole: list[bytes]) -> None:
        self._whole = set(whole)
        self._splitter = FrameSplitter()
        self.counts = Counter({"passed": 0, "withheld": 0})
        self.longest = 0
        self.complaints: list[str] = []

    def feed(self, stream: Iterator[bytes]) -> None:
        """Read all chunks of a stream."""
        for chunk in stream:
            self.counts["bytes"] += len(chunk)
            for stuffed in self._splitter.feed(chunk):
                self.counts["runs"] += 1
                if stuffed in self._whole:
                    self.counts["whole"] += 1
                else:
                    self.take(stuffed)
            self.longest = max(self.longest, len(self._splitter.pending))
        self.counts["overlong"] = self._splitter.overlong
        if self.longest > LONGEST_FRAME:
            self.complaints.append(f"a splitter kept {self.longest} bytes")

    def take(self, stuffed: bytes) -> None:
        """Handle one run of bytes."""
        raise NotImplementedError


class HostSide(Side):
    """The host's decoder."""

    def take(self, stuffed: bytes) -> None:
        """Decode it or refuse it."""
        try:
            open_envelope(stuffed)
            self.counts["passed"] += 1
            decode_frame(stuffed)
        except FrameError:
            self.counts["refused"] += 1


class CartSide(Side):
    """The firmware of a homed and disarmed cart, which also runs some periods."""

    def __init__(self, whole: list[bytes]) -> None:
        super().__init__(whole)
        self._firmware = Firmware(lambda: 3_000)
        self._firmware.homed = True
        self._now_us = 0

    def take(self, stuffed: bytes) -> None:
        """Give it to the firmware and check that the cart does not move."""
        envelope = opened(stuffed)
        if envelope is not None:
            self.counts["passed"] += 1
            if envelope.kind in (Start.TYPE, Home.TYPE):
                self.counts["withheld"] += 1
                return
        answers = self._firmware.receive(stuffed, self._now_us)
        self.counts["answers"] += len(answers)
        if envelope is None:
            self.counts["refused"] += 1
            if answers:
                self.complaints.append(f"{stuffed.hex(' ')} was answered")
        if self._firmware.armed or self._firmware.homing:
            self.complaints.append(f"{stuffed.hex(' ')} set the cart in motion")
            self._firmware.armed = False
        if self.counts["runs"] % TICK_EVERY == 0:
            self._tick()

    def _tick(self) -> None:
        end_us = self._now_us + self._firmware.period_us
        motors = set()
        while self._now_us < end_us:
            self._firmware.drive(self._now_us)
            motors.add(self._firmware.motor)
            self._now_us = self._firmware.next_due(end_us)
            self._firmware.look(self._now_us, 0, 0)
        state = decode_frame(self._firmware.tick(end_us, 0, 0)[-1][:-1]).message
        self.counts["periods"] += 1
        if motors != {0} or not isinstance(state, State) or state.motor_applied:
            self.complaints.append(f"the motor ran in period {self.counts['periods']}")


def opened(stuffed: bytes) -> Envelope | None:
    """Return the envelope of a run of bytes whose checksum is right, else None."""
    try:
        return open_envelope(stuffed)
    except FrameError:
        return None


def peak_megabytes() -> float:
    """Return the peak resident memory; ru_maxrss is in KiB on Linux, in bytes on macOS."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def frames_of(messages: list[Message]) -> list[bytes]:
    """Return valid frames of each message with a few sequence numbers."""
    return [encode_frame(message, sequence)[:-1] for message in messages for sequence in (0, 1, 3, 200)]


def main() -> int:
    """Feed noise and damaged frames to both sides; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--noise", type=int, default=10_000_000, help="random bytes for each side (10^7)")
    parser.add_argument("--frames", type=int, default=1_000_000, help="damaged frames for each side (10^6)")
    parser.add_argument("--seed", type=int, default=0, help="of the bytes and damages (0)")
    options = parser.parse_args()
    from_cart, from_host = frames_of(FROM_CART), frames_of(FROM_HOST)
    complaints: list[str] = []
    print(f"memory before: {peak_megabytes():.1f} MiB")
    for name, kind, whole in (("host", HostSide, from_cart), ("cart", CartSide, from_host)):
        for source in ("noise", "frames"):
            dice, started, side = random.Random(f"{source} {options.seed}"), time.perf_counter(), kind(whole)
            side.feed(
                noise(options.noise, dice) if source == "noise" else damaged(options.frames, whole, dice)
            )
            counts = ", ".join(f"{count} {item}" for item, count in side.counts.items())
            print(
                f"{source} to the {name}: {counts}; splitter at most {side.longest} bytes kept; "
                f"peak {peak_megabytes():.1f} MiB; {time.perf_counter() - started:.0f} s"
            )
            complaints += side.complaints
    print("\n".join(complaints) or "no complaints")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
