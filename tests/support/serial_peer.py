"""Stand-ins at the other end of a pseudo-terminal, which answer byte for byte like a cart."""

import fcntl
import os
import select
import struct
import termios
import threading
import tty
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from cartpole_rl.plants.serial.connection import WATCHDOG_PERIODS
from cartpole_rl.plants.settings import SerialSettings
from cartpole_rl.wire.frames import Frame, FrameSplitter, decode_frame, encode_frame
from cartpole_rl.wire.messages import (
    Ack,
    Flags,
    Hello,
    Home,
    Info,
    Message,
    Nack,
    Reason,
    SetMotor,
    SetPeriod,
    Start,
    StartPolicy,
    State,
    Stop,
    ticks_between,
)

INFO = Info(2, 2, 3, 4096, 22749, 255, 14000, 17000, 20000, 0)
HANGING = 2048  # pole counts


class Peer:
    """Reads frames from the port and writes what `answer` gives for each. Silent itself."""

    def __init__(self, boot: bytes = b"") -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.received: list[Frame] = []
        self._sequence = 0
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, daemon=True)
        if boot:
            os.write(self.master, boot)

    def answer(self, frame: Frame) -> Iterable[bytes]:
        """Bytes to send for a frame of the host."""
        return ()

    def encode(self, message: Message, flags: int = 0) -> bytes:
        self._sequence += 1
        return encode_frame(message, self._sequence, flags)

    def send(self, data: bytes) -> None:
        os.write(self.master, data)

    def unread(self) -> int:
        """Bytes that wait for the host to read them."""
        return struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)))[0]

    def messages(self, kind: type[Message]) -> list[Message]:
        return [frame.message for frame in self.received if isinstance(frame.message, kind)]

    def _run(self) -> None:
        splitter = FrameSplitter()
        while True:
            ready = select.select([self.master, self._wake_read], [], [])[0]
            if self._wake_read in ready:
                return
            for stuffed in splitter.feed(os.read(self.master, 4096)):
                frame = decode_frame(stuffed)
                self.received.append(frame)
                for data in self.answer(frame):
                    self.send(data)

    def __enter__(self) -> "Peer":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        os.write(self._wake_write, b"x")
        self._thread.join()
        for descriptor in (self.master, self._slave, self._wake_read, self._wake_write):
            if descriptor >= 0:
                os.close(descriptor)

    def unplug(self) -> None:
        """Close both ends, as a pulled cable does; the thread ends."""
        os.write(self._wake_write, b"x")
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)
        self.master = self._slave = -1


class CartPeer(Peer):
    """HELLO gives INFO, the rest ACK, and each frame a state; if `paced`, only `tick` gives one.

    A motor value other than 0 that answers a state three ticks old is refused.
    """

    def __init__(self, boot: bytes = b"", paced: bool = False) -> None:
        super().__init__(boot)
        self.paced = paced
        self.flags = Flags(0)
        self.state = State(0, 0, 0, HANGING, 0, 0, 0, 65535)
        self.info = INFO

    def answer(self, frame: Frame) -> Iterable[bytes]:
        message = frame.message
        if isinstance(message, SetMotor) and message.motor and self.is_stale(message):
            yield self.encode(Nack(frame.sequence, message.TYPE, Reason.STALE))
            if not self.paced:
                yield self.next_state()
            return
        self.state = replace(self.state, last_sequence=frame.sequence)
        if isinstance(message, SetPeriod):
            self.info = replace(self.info, period_us=message.period_us)
        if isinstance(message, Hello | SetPeriod):
            yield self.encode(self.info)
        elif isinstance(message, SetMotor):
            self.state = replace(self.state, motor_applied=message.motor)
        else:
            self.carry_out(message)
            yield self.encode(Ack(frame.sequence, message.TYPE))
        if not self.paced:
            yield self.next_state()

    def is_stale(self, message: SetMotor) -> bool:
        return ticks_between(message.tick, self.state.tick) >= WATCHDOG_PERIODS

    def next_state(self, **changes: int) -> bytes:
        """The bytes of the state of the next tick."""
        ticked = {"tick": self.state.tick + 1, "time_us": (self.state.time_us + self.info.period_us) % 2**32}
        self.state = replace(self.state, **(ticked | changes))
        return self.encode(self.state, self.flags)

    def tick(self, **changes: int) -> int:
        """A period passes: the state goes out. Returns its bytes."""
        state = self.next_state(**changes)
        self.send(state)
        return len(state)

    def carry_out(self, message: Message) -> None:
        if isinstance(message, Home):
            self.flags |= Flags.HOMED
        elif isinstance(message, Start | StartPolicy):
            self.flags |= Flags.ARMED
        elif isinstance(message, Stop):
            self.flags &= ~Flags.ARMED
            self.state = replace(self.state, motor_applied=0)


class Refusing(CartPeer):
    """Refuses messages of one type with one reason."""

    def __init__(self, kind: type, reason: int) -> None:
        super().__init__()
        self.kind, self.reason = kind, reason

    def answer(self, frame: Frame) -> Iterable[bytes]:
        if isinstance(frame.message, self.kind):
            yield self.encode(Nack(frame.sequence, frame.message.TYPE, self.reason))
            yield self.next_state()
        else:
            yield from super().answer(frame)


class Forgetful(CartPeer):
    """Does not hear the first `deaf_to` messages of one type."""

    def __init__(self, kind: type, deaf_to: int) -> None:
        super().__init__()
        self.kind, self.deaf_to = kind, deaf_to

    def answer(self, frame: Frame) -> Iterable[bytes]:
        if isinstance(frame.message, self.kind) and self.deaf_to:
            self.deaf_to -= 1
            return
        yield from super().answer(frame)


class HomingForever(Forgetful):
    """Homes until it is stopped; hears no STOP while `deaf_to` is above 0."""

    def __init__(self) -> None:
        super().__init__(Stop, 0)

    def carry_out(self, message: Message) -> None:
        super().carry_out(message)
        if isinstance(message, Home | Stop):
            self.flags = Flags.HOMING if isinstance(message, Home) else Flags(0)


class Between:
    """A cable between a cart's port and the new `port`: frames pass, some with a sign changed.

    `motor`, `cart` and `pole` are 1, or -1 for a motor or an encoder that is connected the wrong way round.
    """

    def __init__(self, cart_port: str, motor: int = 1, cart: int = 1, pole: int = 1) -> None:
        self.signs = motor, cart, pole
        self._master, self._slave = os.openpty()
        self._cart = os.open(cart_port, os.O_RDWR | os.O_NOCTTY)
        for line in (self._slave, self._cart):
            tty.setraw(line)
        self.port = os.ttyname(self._slave)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def cut(self) -> None:
        """Pull the cable: both sides are gone."""
        if self._thread.is_alive():
            os.write(self._wake_write, b"x")
            self._thread.join()
            for descriptor in (self._master, self._slave, self._cart, self._wake_read, self._wake_write):
                os.close(descriptor)

    def __enter__(self) -> "Between":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.cut()

    def _run(self) -> None:
        ways = {self._master: (FrameSplitter(), self._cart), self._cart: (FrameSplitter(), self._master)}
        while True:
            ready = select.select([*ways, self._wake_read], [], [])[0]
            if self._wake_read in ready:
                return
            for source in ready:
                splitter, target = ways[source]
                for stuffed in splitter.feed(os.read(source, 4096)):
                    frame = decode_frame(stuffed)
                    os.write(target, encode_frame(self._turned(frame.message), frame.sequence, frame.flags))

    def _turned(self, message: Message) -> Message:
        motor, cart, pole = self.signs
        if isinstance(message, SetMotor):
            return replace(message, motor=motor * message.motor)
        if isinstance(message, State):
            return replace(
                message,
                motor_applied=motor * message.motor_applied,
                cart_counts=cart * message.cart_counts,
                pole_counts=message.pole_counts if pole > 0 else 2 * HANGING - message.pole_counts,
            )
        return message


def quick_settings(port: str, **changes: float) -> SerialSettings:
    quick = {"timeout": 0.4, "connect_timeout": 2.0, "answer_timeout": 0.2, "retries": 1, "nudge_after": 0.1}
    return SerialSettings(port=port).model_copy(update=quick | changes)  # quicker than the bounds allow


def wait_for(condition: Callable[[], bool], seconds: float = 5.0) -> None:
    event = threading.Event()
    for _ in range(int(seconds / 0.005)):
        if condition():
            return
        event.wait(0.005)
    raise AssertionError("waited in vain")


def open_descriptors() -> int:
    """File descriptors that this process holds."""
    return len(list(Path("/proc/self/fd").iterdir()))
