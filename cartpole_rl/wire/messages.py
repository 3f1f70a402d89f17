"""The messages of protocol version 2. Numbers are little-endian; `LAYOUT` is a payload in `struct` notation.

Host to cart: HELLO, START, STOP, SET_MOTOR, HOME, CLEAR_FAULT, SET_PERIOD, START_POLICY.
Cart to host: INFO, STATE (each period), ACK, NACK, FAULT.

To add a message, add its type and its class; docs/extending.md shows all steps.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar, Self

from cartpole_rl.errors import FrameError

FROM_CART = 0x80  # the bit of a type byte that is set in frames from the cart
MOST_COUNTS = 2**31 - 1  # of an encoder, in a STATE


class MessageType(IntEnum):
    """The type byte of a frame."""

    HELLO = 0x01
    START = 0x02
    STOP = 0x03
    SET_MOTOR = 0x04
    HOME = 0x05
    CLEAR_FAULT = 0x06
    SET_PERIOD = 0x07
    START_POLICY = 0x08
    INFO = 0x81
    STATE = 0x82
    ACK = 0x83
    NACK = 0x84
    FAULT = 0x85


class Flags(IntFlag):
    """The flags byte of frames from the cart; the host sends 0."""

    ARMED = 0x01
    HOMED = 0x02
    HOMING = 0x04
    FAULTED = 0x08
    SOFT_LIMIT = 0x10  # the limits hold the motor value at 0, or brake the cart, or did since the last STATE
    WATCHDOG = 0x20  # the newest accepted SET_MOTOR answers a state three periods old or older; motor 0
    LEFT_SWITCH = 0x40  # the firmware homes by an end switch there
    RIGHT_SWITCH = 0x80


class Fault(IntFlag):
    """Latched faults; the motor is 0 until CLEAR_FAULT."""

    NONE = 0
    HARD_LIMIT = 0x0001
    STALL = 0x0002
    CART_ENCODER = 0x0004
    POLE_ENCODER = 0x0008
    HOMING = 0x0010  # the cart moved the wrong way, no stop was found, the span was wrong, or the pole swings
    # with HOMING or HARD_LIMIT: an end switch was pressed where it cannot be, or not pressed at its end
    LEFT_SWITCH = 0x0020
    RIGHT_SWITCH = 0x0040


class Reason(IntEnum):
    """The reasons for which the cart refuses a message."""

    UNKNOWN_TYPE = 1
    BAD_LENGTH = 2
    OUT_OF_RANGE = 3
    NOT_HOMED = 4
    NOT_ARMED = 5
    FAULT_LATCHED = 6
    BUSY = 7
    BAD_VERSION = 8
    STALE = 9  # a motor value other than 0 that answers a state three periods old or older


MESSAGES: dict[int, "type[Message]"] = {}  # by type byte; each valid message enters itself


class Message:
    """Base class of the messages; packs and unpacks the fields in their order."""

    TYPE: ClassVar[MessageType]
    LAYOUT: ClassVar[str] = ""

    def __init_subclass__(cls, *, valid: bool = True) -> None:
        if valid:
            MESSAGES[cls.TYPE] = cls

    def pack(self) -> bytes:
        """Return the payload. Raises FrameError if a field does not fit its width."""
        try:
            return struct.pack("<" + self.LAYOUT, *vars(self).values())
        except struct.error as error:
            raise FrameError(f"{self.TYPE.name} does not fit its layout {self.LAYOUT!r}: {error}") from None

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Return the message in `payload`. Raises FrameError for a wrong length or an undefined value."""
        if len(payload) != struct.calcsize("<" + cls.LAYOUT):
            raise FrameError(
                f"{cls.TYPE.name} has {len(payload)} payload bytes, not {struct.calcsize('<' + cls.LAYOUT)}"
            )
        try:
            return cls(*struct.unpack("<" + cls.LAYOUT, payload))
        except ValueError as error:
            raise FrameError(f"{cls.TYPE.name}: {error}") from None


@dataclass(frozen=True)
class Hello(Message):
    """Asks for INFO."""

    TYPE = MessageType.HELLO


@dataclass(frozen=True)
class Start(Message):
    """Arms the motor. Refused unless the cart is homed and has no fault."""

    TYPE = MessageType.START


@dataclass(frozen=True)
class Stop(Message):
    """Sets motor 0, disarms and ends homing. Never refused."""

    TYPE = MessageType.STOP


@dataclass(frozen=True)
class SetMotor(Message):
    """Sets the motor value, -255 to 255, positive to the right. Refused if it answers an old state."""

    TYPE = MessageType.SET_MOTOR
    LAYOUT = "hI"
    motor: int
    tick: int = 0  # of the STATE that it answers; any for motor value 0, which is never too old


@dataclass(frozen=True)
class Home(Message):
    """Starts homing: touch both stops, check the span, centre, wait until the pole is still, set zeros.

    Homing ends if no frame is accepted for half a second.
    """

    TYPE = MessageType.HOME


@dataclass(frozen=True)
class ClearFault(Message):
    """Clears the latched faults. One whose cause persists is latched again on arming or homing."""

    TYPE = MessageType.CLEAR_FAULT


@dataclass(frozen=True)
class SetPeriod(Message):
    """Sets the control period in microseconds, 5000 to 100000. Refused while armed or homing."""

    TYPE = MessageType.SET_PERIOD
    LAYOUT = "I"
    period_us: int


@dataclass(frozen=True)
class StartPolicy(Message):
    """Arms the motor and lets the policy on the board drive. Unknown to a cart without one."""

    TYPE = MessageType.START_POLICY


@dataclass(frozen=True)
class Info(Message):
    """The properties of the cart. Answers HELLO and SET_PERIOD."""

    TYPE = MessageType.INFO
    LAYOUT = "BBBHIhiiII"
    firmware_major: int
    firmware_minor: int
    firmware_patch: int
    pole_counts_per_turn: int
    cart_nanometres_per_count: int
    motor_limit: int
    soft_limit_counts: int  # from the middle; outward commands are held at 0 beyond this
    hard_limit_counts: int  # from the middle; HARD_LIMIT is latched from here on
    period_us: int
    policy: int  # identity of the agent on the board, 1 or more; 0 without one


@dataclass(frozen=True)
class State(Message):
    """The cart's measurements, once a period. Counts are 0 in the middle of the track and at upright."""

    TYPE = MessageType.STATE
    LAYOUT = "IIiihBHH"
    tick: int
    time_us: int  # the cart's clock, wraps at 2**32
    cart_counts: int  # positive to the right
    pole_counts: int  # positive to the right, not wrapped at a turn
    motor_applied: int
    last_sequence: int  # of the newest host frame that was accepted
    fault: int
    command_age_ms: int  # since the newest accepted SET_MOTOR; 65535 for longer or never


@dataclass(frozen=True)
class Ack(Message):
    """Reports that the host frame of this sequence and type was carried out."""

    TYPE = MessageType.ACK
    LAYOUT = "BB"
    sequence: int
    type: int


@dataclass(frozen=True)
class Nack(Message):
    """Reports that the host frame of this sequence and type was refused."""

    TYPE = MessageType.NACK
    LAYOUT = "BBB"
    sequence: int
    type: int
    reason: int


@dataclass(frozen=True)
class FaultReport(Message):
    """Reports a newly latched fault, once; STATE repeats the bits in each period."""

    TYPE = MessageType.FAULT
    LAYOUT = "HI"
    fault: int
    tick: int


WRAP = 2**32  # of ticks, 2.7 years at 50 Hz, and of microseconds, 71.6 minutes


def ticks_between(before: int, after: int) -> int:
    """Return the periods from tick `before` to tick `after`, 0 to 2^32 - 1."""
    return (after - before) % WRAP


def microseconds_between(before_us: int, after_us: int) -> int:
    """Return the microseconds from `before_us` to `after_us` by the cart's clock, 0 to 2^32 - 1."""
    return (after_us - before_us) % WRAP


def seconds_between(before_us: int, after_us: int) -> float:
    """Return the seconds from `before_us` to `after_us` by the cart's clock."""
    return microseconds_between(before_us, after_us) * 1e-6


def went_back(difference: int) -> bool:
    """Return whether a difference of ticks or microseconds is over half a wrap, so the later one is older."""
    return difference > WRAP // 2
