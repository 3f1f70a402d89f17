#!/usr/bin/env python
"""Do the Python and the C firmware answer any traffic with the same bytes, and are they in the same state?

    scripts/fuzz/two_firmwares.py --bytes 10000000 --frames 1000000 --seed 0
    scripts/fuzz/two_firmwares.py --rig '{"cart_nanometres_per_count": 50000, "track_span": 0.5}'

Both receive the same input: random bytes; frames of any type, valid or damaged, between periods with any
counts; and whole runs on a rough cart with homing, driving, latencies, other periods, silence and failing
encoders. In the runs, one of the two moves the cart, in turn. After each frame and each period the answers,
the motor values and the whole state of the two are compared. The C firmware is compiled with the address and
undefined-behaviour sanitizers of the compiler (`--plain`: without them), which end the run at the first
error. Prints counts. Exit status 1 at the first difference, which is printed.
"""

import argparse
import ctypes
import json
import os
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from firmware_state import state_of
from toy_cart import ToyCart
from wire import FROM_HOST, damaged, frames_of, noise

from cartpole_rl.emulator import c_firmware
from cartpole_rl.emulator.c_firmware import CFirmware
from cartpole_rl.emulator.firmware import Firmware
from cartpole_rl.rig.hardware import Hardware, hardware_of, nominal_hardware
from cartpole_rl.wire.frames import END, VERSION, FrameSplitter, crc16, encode_frame, stuff
from cartpole_rl.wire.messages import ClearFault, Hello, Home, Message, SetMotor, SetPeriod, Start, Stop

SANITIZERS = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
SPLITTER_BYTES = 256  # at least the size of a cart_splitter
LONGEST_INPUT = 4096  # bytes at once
LARGEST_COUNT = 2**30
FRAMES_PER_PERIOD = 20
PERIODS_PER_DRIVE = 3000
KINDS = ("noise", "damaged", "any", "drive")


class DifferenceError(Exception):
    """The two firmwares differ."""


class Pair:
    """Both firmwares with their splitters, at the same time of the same cart."""

    def __init__(self, seed: int, largest_delay_us: int, counts: Counter[str], rig: Hardware) -> None:
        self.counts, self.rig = counts, rig
        self._dice = [random.Random(seed), random.Random(seed)]

        def delay(number: int) -> int:
            return self._dice[number].randint(0, largest_delay_us)

        self.python = Firmware(lambda: delay(0), hardware=rig)
        self.c = CFirmware(lambda: delay(1), hardware=rig)
        self._splitter = FrameSplitter()
        self._library = c_firmware.load_library(hardware=rig)
        self._c_splitter = ctypes.create_string_buffer(SPLITTER_BYTES)
        self._runs = ctypes.create_string_buffer(2 * LONGEST_INPUT + 65)
        self._last = b""
        self.now_us = 0

    def feed(self, data: bytes) -> None:
        """Let bytes arrive now."""
        self.counts["bytes"] += len(data)
        runs = list(self._splitter.feed(data))
        size = self._library.cart_runs(self._c_splitter, data, len(data), self._runs)
        self._same("runs", b"".join(bytes([len(run)]) + run for run in runs), self._runs.raw[:size])
        for run in runs:
            self._last = run
            self.counts["frames"] += 1
            answers = [firmware.receive(run, self.now_us) for firmware in (self.python, self.c)]
            self._same("answers", *answers)
            self._same("carried out", self.python.carried_out, self.c.carried_out)
            self._same_state()
            self.counts["answers"] += len(answers[0])

    def send(self, message: Message) -> None:
        """Let a valid frame arrive now."""
        self.feed(encode_frame(message, self.counts["frames"]))

    def drive(self, until_us: int, leader: int) -> int:
        """Bring motor values into force; return that of the firmware that moves the cart, as it is now.

        It stays in force until `now_us`, which is moved on to the next motor value or to `until_us`.
        """
        firmwares = (self.python, self.c)
        for firmware in firmwares:
            firmware.drive(self.now_us)
        motors = [firmware.motor for firmware in firmwares]
        dues = [firmware.next_due(until_us) for firmware in firmwares]
        self._same("motor values", *motors)
        self._same("next motor values", *dues)
        self.now_us = dues[leader]
        return motors[leader]

    def look(self, cart: int, pole: int, switches: int = 0) -> None:
        """Look at the counts and the end switches."""
        self.counts["looks"] += 1
        for firmware in (self.python, self.c):
            firmware.switches = switches
            firmware.look(self.now_us, cart, pole)
        self.counts["braked looks"] += self.python._limits.brake != 0
        self._same_state()

    def tick(self, cart: int, pole: int) -> None:
        """End the period with two counts."""
        self.counts["periods"] += 1
        frames = [firmware.tick(self.now_us, cart, pole) for firmware in (self.python, self.c)]
        self._same("frames", *frames)
        self._same_state()

    def _same_state(self) -> None:
        pairs = zip(state_of(self.python), self.c.snapshot, strict=True)
        different = {number: pair for number, pair in enumerate(pairs) if pair[0] != pair[1]}
        if different:
            raise DifferenceError(f"state differs at {self.now_us} us: {different}")

    def _same(self, name: str, python: object, c: object) -> None:
        if python != c:
            raise DifferenceError(
                f"{name} differ at {self.now_us} us after {self._last.hex(' ')}:\npython {python}\nc      {c}"
            )


def any_frame(dice: random.Random, tick: int) -> bytes:
    """Return a frame with a right checksum: mostly of a known type and length, with any content.

    `tick` is that of the newest state.
    """
    version = VERSION if dice.random() < 0.95 else dice.randrange(256)
    kind = dice.randrange(1, 9) if dice.random() < 0.9 else dice.randrange(256)
    length = {4: 6, 7: 4}.get(kind, 0) if dice.random() < 0.9 else dice.randrange(48)
    payload = dice.randbytes(length)
    if kind == SetMotor.TYPE and length == 6:
        newest = tick - dice.choice([0, 0, 0, 1, 2, 3, 4, dice.randrange(2**32)])
        payload = SetMotor(dice.randint(-300, 300), newest % 2**32).pack()
    if kind == SetPeriod.TYPE and length == 4:
        payload = dice.choice([dice.randint(4_000, 110_000), 20_000, 5_000, 5_001]).to_bytes(4, "little")
    body = bytes((version, kind, dice.randrange(256), dice.randrange(256))) + payload
    return stuff(body + crc16(body).to_bytes(2, "little")) + END


def traffic(kind: str, pair: Pair, dice: random.Random, size: int) -> None:
    """Feed random bytes, damaged frames or any frames, with a period now and then."""
    streams = {
        "noise": noise(size, dice),
        "damaged": damaged(size, frames_of(FROM_HOST), dice),
        "any": (any_frame(dice, pair.python._ticks) for _ in range(size)),
    }
    pair.python.homed = pair.c.homed = dice.random() < 0.8
    cart = pole = 0
    for data in streams[kind]:
        pair.feed(data)
        if dice.random() < 1 / FRAMES_PER_PERIOD or len(data) > 64:
            jump = dice.choice([3, 100, 1000, 10_000])
            cart += dice.randint(-jump, jump)
            pole += dice.randint(-jump, jump) if dice.random() < 0.7 else 0
            if dice.random() < 0.01:
                cart, pole = (dice.randint(-LARGEST_COUNT, LARGEST_COUNT) for _ in range(2))
            end_us = pair.now_us + dice.choice([pair.python.period_us, dice.randint(1, 200_000)])
            while pair.now_us < end_us:
                pair.drive(min(end_us, pair.now_us + dice.randint(1, 60_000)), 0)
                pair.look(cart, pole, dice.choice([0, 0, 0, 0, 0, 0, 1, 2, 3, 255]))
            pair.tick(cart, pole)


def rough_drive(pair: Pair, dice: random.Random, leader: int) -> None:
    """Home a rough cart and drive it with random motor values, pauses and failures."""
    toy, jitter = ToyCart(dice, pair.rig), dice.choice([0, 0, 300])
    between_looks_us = dice.choice([1000, 1000, 4000])
    silence = 0  # periods in which the host sends nothing
    pair.send(SetPeriod(dice.choice([20_000, 20_000, 10_000, 5_000, 33_333, 100_000])))
    failing, strange = dice.choice([0.0, 0.0005, 0.01]), dice.choice([0.0, 0.0, 0.0003, 0.05])

    def period() -> None:
        length_us = max(1, pair.python.period_us + dice.randint(-jitter, jitter))
        rest_us = dice.randint(0, length_us)
        for us in (length_us - rest_us, rest_us):
            end_us = pair.now_us + us
            while (since_us := pair.now_us) < end_us:
                motor = pair.drive(min(end_us, since_us + between_looks_us), leader)
                toy.advance(motor, pair.now_us - since_us)
                pair.look(*toy.counts(), toy.switches())
            if dice.random() < strange:
                pair.feed(any_frame(dice, pair.python._ticks))
        toy.maybe_fail(failing)
        pair.tick(*toy.counts())

    motor, lasts = 0, 0
    for _ in range(PERIODS_PER_DRIVE):
        firmware = pair.python
        if firmware.fault and dice.random() < 0.1:
            toy.repair()
            pair.send(ClearFault())
        silence = silence - 1 if silence else dice.choice([0] * 3000 + [2, 5, 40])
        if silence:
            pass
        elif firmware.homing and dice.random() < 0.9:
            pair.send(Hello())
        elif not firmware.homed and not firmware.homing and dice.random() < 0.3:
            pair.send(Home())
        elif firmware.homed and not firmware.armed and dice.random() < 0.3:
            pair.send(Start())
        elif firmware.armed:
            if lasts == 0:
                lasts, motor = dice.randint(1, 40), dice.choice([dice.randint(-255, 255), 200, -200, 255, 0])
            lasts -= 1
            for _ in range(dice.choice([0, 1, 1, 1, 1, 2])):
                pair.send(SetMotor(motor, firmware._ticks - dice.choice([0, 0, 0, 0, 1, 2, 3])))
            if dice.random() < 0.002:
                pair.send(Stop())
        homed, homing, fault = firmware.homed, firmware.homing, firmware.fault
        period()
        pair.counts["homings"] += firmware.homed and not homed
        pair.counts["homings without a host"] += homing and not (
            firmware.homing or firmware.homed or firmware.fault
        )
        for new in firmware.fault & ~fault:
            pair.counts[str(new.name)] += 1


def run(total_bytes: int, total_frames: int, seed: int, rig: Hardware | None = None) -> Counter[str]:
    """Compare the two until so many random bytes and so many frames have arrived. Raises DifferenceError.

    The rig is ip02's if it is None.
    """
    rig = rig or nominal_hardware()
    counts: Counter[str] = Counter()
    session = random_bytes = 0
    while random_bytes < total_bytes or counts["frames"] < total_frames:
        kind = KINDS[session % len(KINDS)]
        if kind == "noise" and random_bytes >= total_bytes:
            kind = "drive"
        dice = random.Random(f"{session} {seed}")
        pair = Pair(dice.randrange(2**31), dice.choice([0, 3_000, 60_000]), counts, rig)
        if kind == "drive":
            rough_drive(pair, dice, leader=session // len(KINDS) % 2)
        else:
            size = min(total_bytes, 200_000) if kind == "noise" else min(2_000, 1 + total_frames // 10)
            random_bytes += size if kind == "noise" else 0
            traffic(kind, pair, dice, size)
        counts[f"sessions of {kind}"] += 1
        session += 1
    counts["random bytes"] = random_bytes
    return counts


def restart_with_sanitizers() -> int:
    """Run this script again with the address sanitizer loaded before Python; return its exit status."""
    compiler = c_firmware.find_compiler()
    found = subprocess.run([compiler, "-print-file-name=libasan.so"], capture_output=True, text=True)
    if not Path(found.stdout.strip()).is_absolute():
        sys.exit(f"{compiler} has no libasan.so, which the address sanitizer needs; add --plain")
    environment = {
        **os.environ,
        "LD_PRELOAD": found.stdout.strip(),
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONMALLOC": "malloc",
    }
    return subprocess.run([sys.executable, *sys.argv], env=environment).returncode


def main() -> int:
    """Compare the two firmwares; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bytes", type=int, default=10_000_000, help="random bytes (10^7)")
    parser.add_argument("--frames", type=int, default=1_000_000, help="runs of bytes that end in 0x00 (10^6)")
    parser.add_argument("--seed", type=int, default=0, help="of all input (0)")
    parser.add_argument("--rig", default="{}", help="numbers of the rig as JSON; the rest is ip02's")
    parser.add_argument("--plain", action="store_true", help="compile without sanitizers")
    options = parser.parse_args()
    if not options.plain:
        if "libasan" not in os.environ.get("LD_PRELOAD", ""):
            return restart_with_sanitizers()
        c_firmware.FLAGS = [*c_firmware.FLAGS, *SANITIZERS]
    started = time.perf_counter()
    try:
        counts = run(options.bytes, options.frames, options.seed, hardware_of(json.loads(options.rig)))
    except DifferenceError as difference:
        print(difference)
        return 1
    print(", ".join(f"{count} {name}" for name, count in counts.items()))
    print(f"no difference; {time.perf_counter() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
