"""A host for tests: starts an emulator as its own process and speaks to its port with pyserial."""

import contextlib
import json
import subprocess
import sys
from collections import deque
from collections.abc import Iterator

import serial
from firmwares import UnderTest, answering

from cartpole_rl.errors import FrameError
from cartpole_rl.plants.serial.cart import LEASE_RENEWAL_US
from cartpole_rl.wire.frames import Frame, FrameSplitter, decode_frame, encode_frame
from cartpole_rl.wire.messages import Flags, Hello, Home, Message, State

SILENCE = 200.0  # s, timeout of a test


class EmulatorHost:
    """The port of a running emulator and all bytes received from it."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        self.process = process
        self.ready = json.loads(process.stdout.readline())
        self.came = b""
        self.flags = Flags(0)  # of the newest STATE
        self.tick = self.time_us = 0  # of that STATE
        self.damaged = 0
        self._sequence = 0
        self.open()

    def open(self) -> None:
        """Open the port as a new host does."""
        self.serial = serial.Serial(self.ready["port"], 921600, timeout=SILENCE, exclusive=True)
        self._splitter = FrameSplitter()
        self._frames: deque[Frame] = deque()

    def send(self, message: Message) -> None:
        self.serial.write(encode_frame(answering(self.tick, message), self._sequence))
        self._sequence += 1

    def frame(self) -> Frame:
        """Return the next undamaged frame."""
        while not self._frames:
            data = self.serial.read(max(1, self.serial.in_waiting))
            assert data, "the emulator is silent"
            self.came += data
            for stuffed in self._splitter.feed(data):
                try:
                    self._frames.append(decode_frame(stuffed))
                except FrameError:
                    self.damaged += 1
        return self._frames.popleft()

    def until_state(self) -> list[Frame]:
        """Return the frames up to and including the next STATE."""
        frames = [self.frame()]
        while not isinstance(message := frames[-1].message, State):
            frames.append(self.frame())
        self.tick, self.time_us = message.tick, message.time_us
        return frames

    def state(self) -> State:
        """Return the next STATE."""
        frame = self.until_state()[-1]
        message, self.flags = frame.message, Flags(frame.flags)
        assert isinstance(message, State)
        return message

    def ask(self, message: Message) -> list[Frame]:
        """Send a message; return the frames up to and including the next STATE."""
        self.send(message)
        return self.until_state()

    def home(self) -> Frame:
        """Home the cart; return the STATE that ends homing."""
        asked_us, frame = self.time_us, self.ask(Home())[-1]
        while frame.flags & Flags.HOMING:
            if self.time_us >= asked_us + LEASE_RENEWAL_US:
                asked_us = self.time_us
                self.send(Hello())
            frame = self.until_state()[-1]
        return frame


@contextlib.contextmanager
def emulator(**settings: object) -> Iterator[EmulatorHost]:
    """Run an emulator; terminate it at the end and check that its exit status is 0."""
    given = json.dumps({"firmware": UnderTest.kind} | settings)
    command = [sys.executable, "-m", "cartpole_rl.emulator", given]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        host = EmulatorHost(process)
        yield host
        host.serial.close()
        process.terminate()
        assert process.wait(SILENCE) == 0
    finally:
        process.kill()
        process.wait()
        if process.stdout:
            process.stdout.close()
