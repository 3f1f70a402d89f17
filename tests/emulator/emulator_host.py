"""A host for tests: starts an emulator as its own process and speaks to its port with pyserial."""

import contextlib
import json
import subprocess
import sys
from collections import deque
from collections.abc import Iterator

import serial

from cartpole_rl.errors import FrameError
from cartpole_rl.wire import Flags, Frame, FrameSplitter, Home, Message, State, decode_frame, encode_frame

SILENCE = 20.0  # s until a test gives up


class EmulatorHost:
    """The port of a running emulator, and all that came over it."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        assert process.stdout is not None
        self.process = process
        self.ready = json.loads(process.stdout.readline())
        self.came = b""
        self.flags = Flags(0)  # of the newest STATE
        self.damaged = 0
        self._sequence = 0
        self.open()

    def open(self) -> None:
        """Open the port, as a host does that starts anew."""
        self.serial = serial.Serial(self.ready["port"], 921600, timeout=SILENCE, exclusive=True)
        self._splitter = FrameSplitter()
        self._frames: deque[Frame] = deque()

    def send(self, message: Message) -> None:
        self.serial.write(encode_frame(message, self._sequence))
        self._sequence += 1

    def frame(self) -> Frame:
        """The next undamaged frame."""
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
        """Frames up to the next STATE, that one included."""
        frames = [self.frame()]
        while not isinstance(frames[-1].message, State):
            frames.append(self.frame())
        return frames

    def state(self) -> State:
        """The next STATE."""
        frame = self.until_state()[-1]
        message, self.flags = frame.message, Flags(frame.flags)
        assert isinstance(message, State)
        return message

    def ask(self, message: Message) -> list[Frame]:
        """Send a message; frames up to the next STATE."""
        self.send(message)
        return self.until_state()

    def home(self) -> Frame:
        """The STATE that ends a homing."""
        frame = self.ask(Home())[-1]
        while frame.flags & Flags.HOMING:
            frame = self.until_state()[-1]
        return frame


@contextlib.contextmanager
def emulator(*options: str, **settings: object) -> Iterator[EmulatorHost]:
    """A running emulator; terminated at the end, and its exit status has to be 0."""
    command = [sys.executable, "-m", "cartpole_rl.emulator", json.dumps(settings), *options]
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
