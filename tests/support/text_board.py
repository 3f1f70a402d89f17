"""A maker's board that knows nothing of this package: a stepper cart that sends and takes lines of text.

    python text_board.py '{"journal": "board.txt"}'

It prints its port, then sends `t_us,cart,pole` every 10 ms, and takes `a=<m/s^2>` and `home`. Each line that
it took goes to the journal with the time in s, and once a second the cart's position and speed. The options
are failures: `freeze` (what stands still from second `at` on: "time", "cart", "both"), `garbage` (share of
damaged lines), `silent` (no line from `at` on), `noise` (from `at` on only noise). The `damping` of the pole,
1/s, is so large that it soon hangs still; a swing-up needs less.
"""

import json
import math
import os
import pty
import random
import select
import sys
import time
import tty

LENGTH, INERTIA = 0.15, 7.5e-3 + 0.15**2  # m; m^2: of 1 kg of a 0.3 m rod
PERIOD, STEP = 0.01, 0.0005  # s
STOPS, FASTEST = 0.3, 1.5  # m, m/s
COUNT, TURN, HANGING = 25e-6, 4096, 1000

options = {
    "damping": 2.0,
    "freeze": "",
    "garbage": 0.0,
    "silent": False,
    "noise": False,
    "at": 1e9,
    "journal": os.devnull,
}
options |= json.loads(sys.argv[1]) if len(sys.argv) > 1 else {}
dice = random.Random(1)
master, slave = pty.openpty()
tty.setraw(slave)
print(os.ttyname(slave), flush=True)
journal = open(options["journal"], "w", buffering=1)  # noqa: SIM115, PTH123

x = v = a = w = 0.0
theta = math.pi
begun, ticks, received, frozen = time.perf_counter(), 0, b"", None
clock = 2**32 - 5_000_000  # us: micros() wraps after 5 s
while True:
    ticks += 1
    until = begun + ticks * PERIOD
    while (left := until - time.perf_counter()) > 0:
        if select.select([master], [], [], left)[0]:
            received += os.read(master, 4096)
        while b"\n" in received:
            line, _, received = received.partition(b"\n")
            print(f"{time.perf_counter() - begun:.3f} {line.decode()} x={x:.4f} v={v:.4f}", file=journal)
            if line.startswith(b"a="):
                a = max(-14.0, min(14.0, float(line[2:])))
            elif line == b"home":
                x = v = a = w = 0.0
                theta = math.pi
    for _ in range(round(PERIOD / STEP)):
        pull = 0.0 if abs(v) > FASTEST and a * v > 0 else a
        v += pull * STEP
        x += v * STEP
        if abs(x) > STOPS:
            x, v = math.copysign(STOPS, x), 0.0
        turning = (9.81 * LENGTH * math.sin(theta) - LENGTH * math.cos(theta) * pull) / INERTIA - options[
            "damping"
        ] * w
        w += turning * STEP
        theta += w * STEP
    failing = ticks * PERIOD > options["at"]
    now = (clock + round(ticks * PERIOD * 1e6)) % 2**32
    pole = round(HANGING + (theta - math.pi) * TURN / (2 * math.pi)) % TURN
    measured = [now, round(x / COUNT), pole]
    frozen = frozen if failing and frozen else measured
    measured[0] = frozen[0] if options["freeze"] == "time" else now
    measured[1] = frozen[1] if options["freeze"] in ("cart", "both") else measured[1]
    measured[2] = frozen[2] if options["freeze"] == "both" else measured[2]
    text = ",".join(map(str, measured)).encode()
    if (failing and options["noise"]) or dice.random() < options["garbage"]:
        damage = dice.choice(
            [text[:5], text + text, text[:-1], text.replace(b",", b""), b"\xff\x00" + text, b"nan,1,2"]
        )
        text = damage
    if not (failing and options["silent"]) and select.select([], [master], [], 0)[1]:
        os.write(master, text + b"\n")
