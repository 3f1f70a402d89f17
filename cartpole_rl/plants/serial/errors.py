"""Error messages with remedies for a cart: its refusals, its faults, its INFO.

Positions, angles and forces are computed from the numbers of the cart's file: metres per count, counts per
turn, the span of the track. A cart that reports others is refused: every number would be wrong. So is one
with other end switches: it would home against stops that are not there.
"""

from cartpole_rl.errors import FaultError, LinkError, PlantError
from cartpole_rl.rig.hardware import LARGEST_MOTOR, Hardware
from cartpole_rl.wire.messages import Fault, Flags, Info, MessageType, Nack, Reason

SPAN_TOLERANCE = 0.05  # share; homing accepts 3 %
SHORTEST_PERIOD_US, LONGEST_PERIOD_US = 5_000, 100_000  # docs/protocol.md, SET_PERIOD


class RefusedError(PlantError):
    """The cart answered NACK. `reason` is the protocol's, or a bare number if it is unknown here."""

    def __init__(self, text: str, reason: Reason | int) -> None:
        super().__init__(text)
        self.reason = reason


class LateError(LinkError):
    """The cart refused a motor value that came too late. The link works."""


class NotReadyError(PlantError):
    """A check or a move failed: `found` says what is wrong, `remedy` what to do."""

    def __init__(self, found: str, remedy: str) -> None:
        super().__init__(f"{found}: {remedy}")
        self.found, self.remedy = found, remedy


REASONS: dict[int, str] = {
    Reason.UNKNOWN_TYPE: "it does not know this message: update its firmware",
    Reason.BAD_LENGTH: "the payload has the wrong length: update its firmware, or this program",
    Reason.OUT_OF_RANGE: "the value is out of range",
    Reason.NOT_HOMED: "it is not homed",
    Reason.NOT_ARMED: "its motor is not armed; has it restarted?",
    Reason.FAULT_LATCHED: "a fault is latched: remove its cause, and start again",
    Reason.BUSY: "it is armed or homing; wait until it is homed, or stop it first",
    Reason.BAD_VERSION: "it speaks another protocol version: update its firmware, or this program",
    Reason.STALE: "it answered a state over three periods old, so it came too late: connect the cart by a "
    "short cable, without a network between, and end what keeps this computer busy",
}

SWITCH = (
    "its {} end switch was pressed where it cannot be, or not pressed at its end; or the cart's counts "
    "slipped (press it by hand, check its wires and that the cart reaches it)"
)
FAULTS: dict[Fault, str] = {
    Fault.LEFT_SWITCH: SWITCH.format("left"),  # they come first: the cause of HOMING or HARD_LIMIT
    Fault.RIGHT_SWITCH: SWITCH.format("right"),
    Fault.HARD_LIMIT: "the cart ran into the end of the track (switch the motor's supply off, push the cart "
    "back towards the middle, switch the supply on)",
    Fault.STALL: "the motor was driven but the cart did not move (check the motor's supply and cable, free "
    "the cart)",
    Fault.CART_ENCODER: "the encoder of the cart does not answer, or something holds the cart (check the "
    "encoder's cable and the motor's supply, free the cart)",
    Fault.POLE_ENCODER: "the pole's encoder does not answer (check its cable)",
    Fault.HOMING: "homing failed: the cart did not move, or moved the wrong way, an end stop was not found, "
    "the distance of the end stops was off by over 3 %, or the pole did not come to rest (check the motor's "
    "supply, its direction and the cables of the motor and of both encoders; clear the track, let the "
    "pole hang)",
}


def refusal(nack: Nack) -> PlantError:
    """Return the error for a NACK: FaultError for a latched fault, LateError for delay, else RefusedError."""
    known = nack.type in MessageType.__members__.values()
    what = MessageType(nack.type).name if known else f"message {nack.type:#04x}"
    why = REASONS.get(nack.reason, f"reason {nack.reason}, unknown here")
    if (nack.type, nack.reason) == (MessageType.START_POLICY, Reason.UNKNOWN_TYPE):
        why = "its board has no policy: compile its firmware with one (docs/firmware.md)"
    text = f"the cart refused {what}: {why}"
    if nack.reason == Reason.FAULT_LATCHED:
        return FaultError(text)
    if nack.reason == Reason.STALE:
        return LateError(text)
    return RefusedError(text, Reason(nack.reason) if nack.reason in REASONS else nack.reason)


def fault_words(bits: int) -> str:
    """Return every fault in `bits` in words, each with its remedy."""
    named = [words for fault, words in FAULTS.items() if bits & fault]
    unknown = bits & ~sum(FAULTS)
    if unknown:
        named.append(f"bits {unknown:#06x}, unknown here")
    return "; ".join(named)


def fault_error(bits: int) -> FaultError:
    """Return the error that names every fault in `bits`, each with its remedy."""
    return FaultError(f"the cart latched a fault: {fault_words(bits)}")


def check_rig(information: Info, flags: Flags, hardware: Hardware) -> None:
    """Raise NotReadyError if a cart is not the one of its file, or its period is impossible.

    Its scales and end switches are compared. `flags` are those of one of its states.
    """
    reported = {
        "cart_nanometres_per_count": information.cart_nanometres_per_count,
        "pole_counts_per_turn": information.pole_counts_per_turn,
        "left_switch": int(Flags.LEFT_SWITCH in flags),
        "right_switch": int(Flags.RIGHT_SWITCH in flags),
    }
    if other := [name for name in reported if reported[name] != getattr(hardware, name)]:
        lines = ", ".join(f"`{name}: {reported[name]}`" for name in other)
        raise NotReadyError(
            "the cart reports "
            + " and ".join(f"{name} {reported[name]}, not {getattr(hardware, name)}" for name in other),
            f"if this is true, write {lines} into a file of this cart and give it with cart=; if not, build "
            "its firmware from the file (cartpole-export format=firmware)",
        )
    if information.motor_limit != LARGEST_MOTOR:
        raise NotReadyError(
            f"INFO says motor limit {information.motor_limit}, not {LARGEST_MOTOR}",
            "correct the firmware's settings",
        )
    check_period(information)


def check_period(information: Info) -> None:
    """Raise NotReadyError if the cart's period is none that the protocol allows."""
    if not SHORTEST_PERIOD_US <= information.period_us <= LONGEST_PERIOD_US:
        raise NotReadyError(
            f"INFO says period {information.period_us} us, not {SHORTEST_PERIOD_US} to {LONGEST_PERIOD_US}",
            "correct the firmware's settings",
        )


def check_limits(information: Info, hardware: Hardware) -> None:
    """Raise NotReadyError if the soft and the hard limit do not fit the track."""
    soft = information.soft_limit_counts * hardware.encoders.metres
    hard = information.hard_limit_counts * hardware.encoders.metres
    half_span = hardware.half_span
    least, most = limit_range(hardware)
    if not least < soft < hard < most:
        raise NotReadyError(
            f"INFO says soft limit {soft * 1e3:.0f} mm, hard limit {hard * 1e3:.0f} mm from the middle; the "
            f"soft one comes first, beyond {least * 1e3:.0f} mm, and both before the stop, at "
            f"{half_span * 1e3:.0f} mm",
            "correct the firmware's limits",
        )


def limit_range(hardware: Hardware) -> tuple[float, float]:
    """Return what the soft limit has to be beyond, and the hard limit within, in m from the middle."""
    # on the shortest track that homing accepts, the largest soft limit leaves so much
    return (0.5 - SPAN_TOLERANCE) * hardware.half_span, (1 + SPAN_TOLERANCE) * hardware.half_span
