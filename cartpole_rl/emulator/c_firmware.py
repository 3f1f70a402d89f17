"""The C firmware, ``firmware/src/``, with the methods of `Firmware`: either can run an emulated cart."""

import ctypes
from collections.abc import Callable
from pathlib import Path

from cartpole_rl.emulator.c_library import load_library
from cartpole_rl.emulator.limits import LEVER
from cartpole_rl.wire import Fault, Message, SetMotor
from cartpole_rl.wire.frames import END, open_envelope
from cartpole_rl.wire.messages import MESSAGES

LONGEST_ANSWER = 70  # bytes: 2 * CART_FRAME_BYTES
SNAPSHOT_NUMBERS = 90


class CartHead(ctypes.Structure):
    """The first fields of a `cart` in ``firmware/src/cart.h``."""

    _fields_ = (
        ("policy", ctypes.c_void_p),
        ("policy_memory", ctypes.c_void_p),
        ("policy_identity", ctypes.c_uint32),
        ("pole_trim", ctypes.c_int32),
        ("pole_lever_um", ctypes.c_int32),
        ("period_us", ctypes.c_uint32),
        ("armed", ctypes.c_bool),
        ("homed", ctypes.c_bool),
        ("homing", ctypes.c_bool),
        ("fault", ctypes.c_uint16),
        ("carried_out", ctypes.c_uint8),
    )


class CFirmware:
    """The C firmware of one cart, just booted: idle, not homed, motor 0. Times are us since boot."""

    def __init__(
        self,
        delay_us: Callable[[], int],
        zero_error: int = 0,
        lever_um: int = LEVER,
        policy: Path | None = None,
        pole_length: float = 0.0,
    ) -> None:
        """`delay_us` returns a command's latency; homing sets the pole's zero `zero_error` counts too low.

        `lever_um` is that of `TrackLimits`.
        `policy` is a folder with policy.h and policy.c, of an agent that drives on the board; it may observe
        `pole_length` in m. Raises EmulatorError if the C firmware cannot be compiled.
        """
        self._library = load_library(policy)
        self._memory = ctypes.create_string_buffer(self._library.cart_size())
        self._policy_memory = ctypes.create_string_buffer(max(1, self._library.cart_policy_size()))
        self._head = CartHead.from_buffer(self._memory)
        self._answer = ctypes.create_string_buffer(LONGEST_ANSWER)
        self._library.cart_boot(self._memory)
        self._library.cart_attach_policy(self._memory, self._policy_memory, pole_length)
        self._head.pole_trim, self._head.pole_lever_um = zero_error, lever_um
        self._delay_us = delay_us
        self.carried_out: Message | None = None  # the newest message; None if it was refused or damaged

    @property
    def period_us(self) -> int:
        """The length of the next period."""
        return self._head.period_us

    @property
    def armed(self) -> bool:
        """True while the cart obeys SET_MOTOR."""
        return self._head.armed

    @property
    def homed(self) -> bool:
        """True if the zeros are set."""
        return self._head.homed

    @homed.setter
    def homed(self, homed: bool) -> None:
        self._head.homed = homed

    @property
    def homing(self) -> bool:
        """True while the cart is homing."""
        return self._head.homing

    @property
    def fault(self) -> Fault:
        """The latched faults."""
        return Fault(self._head.fault)

    @property
    def snapshot(self) -> list[int]:
        """The whole state as numbers, in the order of ``firmware/host/library.c``."""
        numbers = (ctypes.c_int64 * SNAPSHOT_NUMBERS)()
        self._library.cart_snapshot(self._memory, numbers)
        return list(numbers)

    def receive(self, stuffed: bytes, now_us: int) -> list[bytes]:
        """Handle one frame without its final 0x00; return the answer, at most one frame."""
        length = self._library.cart_receive(self._memory, stuffed, len(stuffed), now_us, self._answer)
        kind = self._head.carried_out
        self.carried_out = MESSAGES[kind].unpack(open_envelope(stuffed).payload) if kind else None
        if isinstance(self.carried_out, SetMotor):
            self._library.cart_delay_command(self._memory, now_us + self._delay_us())
        return self._frames(length)

    @property
    def motor(self) -> int:
        """The motor value in force."""
        return int(self._library.cart_motor(self._memory))

    def drive(self, now_us: int) -> None:
        """Bring the motor values that are due into force."""
        self._library.cart_drive(self._memory, now_us)

    def next_due(self, before_us: int) -> int:
        """Return when the next motor value is due, `before_us` if none is due before that."""
        return int(self._library.cart_next_due(self._memory, before_us))

    def look(self, now_us: int, cart: int, pole: int) -> None:
        """Apply the rules that cannot wait for the end of a period, to the clock and the raw counts."""
        self._library.cart_look(self._memory, now_us, cart, pole)

    def tick(self, now_us: int, cart: int, pole: int) -> list[bytes]:
        """End a period with two raw counts: apply the rules and return the frames to send, STATE last."""
        length = self._library.cart_tick(self._memory, now_us, cart, pole, self._answer)
        self._library.cart_ask_policy(self._memory)
        return self._frames(length)

    def _frames(self, length: int) -> list[bytes]:
        return [frame + END for frame in self._answer.raw[:length].split(END)[:-1]]
