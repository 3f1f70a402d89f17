#!/usr/bin/env python
"""The C firmware on an emulated processor: a Cortex-M4 in QEMU, with the emulated cart's physics at its pins.

    scripts/qemu/cart.py                           # prints {"port": "/dev/pts/5", ...} and runs until Ctrl-C
    scripts/qemu/cart.py '{"cart_viscous": 1.0}'   # true parameters of the cart, see docs/emulator.md
    cartpole-evaluate run=... plant=serial plant.port=/dev/pts/5
    scripts/qemu/cart.py --policy FOLDER           # with an agent on the board: plant.policy=onboard

Needs the Debian packages qemu-system-arm, gcc-arm-none-eabi, libnewlib-arm-none-eabi and make. It compiles
firmware/ for the board qemu_an386. UART 0 of the board is a pseudo-terminal, which a host opens like any
serial port. UART 1 carries motor values and encoder counts (firmware/boards/qemu_an386/board.c has the
format). The clock of the board follows the wall clock, and the physics follows the clock of the board.
Settings of the clock, the link and faults have no effect.
"""

import argparse
import json
import math
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from cartpole_rl.emulator.c_firmware import rig_header
from cartpole_rl.emulator.physics import CartPhysics
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.rig.hardware import Hardware, nominal_hardware

FIRMWARE = Path(__file__).parents[2] / "firmware"
PROGRAMS = ("qemu-system-arm", "arm-none-eabi-gcc", "make")
PORT = re.compile(r"char device redirected to (\S+) \(label host\)")
MOTOR, CLOCK, COUNT = struct.Struct("<Ih"), struct.Struct("<I"), struct.Struct("<i")
PATIENCE = 20.0  # s for QEMU to start
BOOT = (0.05, math.pi)  # m from the middle and rad from upright
ASKED = (b"X", b"P", b"S")  # what the board sends to ask for a count, or for the end switches


def missing_programs() -> list[str]:
    """Return the programs that are not installed."""
    return [name for name in PROGRAMS if shutil.which(name) is None]


class Pins:
    """The motor, the two encoders and the end switches at the pins of the board, on a cart with physics."""

    def __init__(self, settings: EmulatorSettings) -> None:
        self._physics = CartPhysics(settings)
        self._encoders = (settings.hardware or nominal_hardware()).encoders
        self._physics.place(*BOOT)
        self._boot = self._discs()
        self._clock_us: int | None = None  # of the board, at the present state of the physics
        self._motor = 0

    def serve(self, line: socket.socket) -> None:
        """Answer the board until it is gone."""
        with line.makefile("rb") as stream:
            while kind := stream.read(1):
                if kind in ASKED:
                    self._advance(*CLOCK.unpack(stream.read(CLOCK.size)))
                    cart, pole = (now - boot for now, boot in zip(self._discs(), self._boot, strict=True))
                    answers = dict(zip(ASKED, (cart, pole, self._physics.switches), strict=True))
                    line.sendall(COUNT.pack(answers[kind]))
                else:
                    clock_us, motor = MOTOR.unpack(stream.read(MOTOR.size))
                    self._advance(clock_us)
                    self._motor = motor

    def _advance(self, clock_us: int) -> None:
        """Move the cart until the board's clock, which wraps at 2^32, shows `clock_us`."""
        before = clock_us if self._clock_us is None else self._clock_us
        self._physics.advance(self._motor, (clock_us - before) % 2**32 / 1e6)
        self._clock_us = clock_us

    def _discs(self) -> tuple[int, int]:
        """Return the counts of the encoder discs of cart and pole."""
        pole = math.floor(self._physics.angle / self._encoders.radians + 0.5)
        return math.floor(self._physics.x / self._encoders.metres), pole


def build(folder: Path, policy: Path | None, pole_length: float, hardware: Hardware) -> Path:
    """Compile the firmware for a rig, with a policy if there is one, into a folder; return the program.

    The policy may observe `pole_length`, in m.
    """
    rig = folder / "rig.h"
    rig.write_text(rig_header(hardware, "the emulator's settings"), encoding="utf-8")
    make = ["make", "-C", str(FIRMWARE), f"BUILD={folder}", f"RIG={rig}", "qemu_an386"]
    make += [f"POLICY={policy.resolve()}", f"POLE_LENGTH={pole_length}"] if policy else []
    done = subprocess.run(make, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"the firmware was not compiled: {done.stderr.strip()}")
    return folder / ("qemu_an386-policy.elf" if policy else "qemu_an386.elf")


@contextmanager
def board(program: Path, pins: Path) -> Iterator[str]:
    """Run a program in QEMU; its UART 1 connects to the socket `pins`. Yield the port of its UART 0."""
    command = ["qemu-system-arm", "-machine", "mps2-an386", "-nographic", "-monitor", "none"]
    command += ["-chardev", "pty,id=host", "-chardev", f"socket,id=pins,path={pins}"]
    command += ["-serial", "chardev:host", "-serial", "chardev:pins", "-kernel", str(program)]
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            yield read_port(process, log)
        finally:
            process.terminate()
            process.wait()


def read_port(process: "subprocess.Popen[bytes]", log: TextIO) -> str:
    """Return the pseudo-terminal that QEMU names. Exits if QEMU does not start."""
    deadline = time.monotonic() + PATIENCE
    while True:
        log.seek(0)
        text = log.read()
        if found := PORT.search(text):
            return found[1]
        if process.poll() is not None or time.monotonic() > deadline:
            sys.exit(f"QEMU did not start: {text.strip()}")
        time.sleep(0.05)


def interrupt(number: int, frame: object) -> None:
    """End the program as Ctrl-C does."""
    raise KeyboardInterrupt


def main() -> int:
    """Run the firmware in QEMU until Ctrl-C or SIGTERM; return the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("settings", nargs="?", default="{}", help="settings of the cart as JSON")
    parser.add_argument("--policy", type=Path, help="folder of cartpole-export format=c: the board drives")
    options = parser.parse_args()
    if missing := missing_programs():
        sys.exit(f"not installed: {', '.join(missing)}")
    signal.signal(signal.SIGTERM, interrupt)
    settings = EmulatorSettings.model_validate_json(options.settings)
    pins = Pins(settings)
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listening:
        path = Path(folder, "pins")
        listening.bind(str(path))
        listening.listen(1)
        listening.settimeout(PATIENCE)
        try:
            hardware = settings.hardware or nominal_hardware()
            program = build(Path(folder), options.policy, 2 * settings.pole_com, hardware)
            with board(program, path) as port:
                line, _ = listening.accept()
                print(json.dumps({"port": port}), flush=True)
                with line:
                    pins.serve(line)
        except KeyboardInterrupt:
            return 0
    sys.exit("QEMU ended")


if __name__ == "__main__":
    sys.exit(main())
