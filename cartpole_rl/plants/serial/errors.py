"""Errors for the cart's refusals and faults: their meaning in words, each with its remedy."""

from cartpole_rl.errors import FaultError, LinkError, PlantError
from cartpole_rl.wire import Fault, MessageType, Nack, Reason


class RefusedError(PlantError):
    """The cart answered NACK. `reason` is the protocol's, or a bare number if it is unknown here."""

    def __init__(self, text: str, reason: Reason | int) -> None:
        super().__init__(text)
        self.reason = reason


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

FAULTS: dict[Fault, str] = {
    Fault.HARD_LIMIT: "the cart ran into the end of the track (switch the motor's supply off, push the cart "
    "back towards the middle, switch the supply on)",
    Fault.STALL: "the motor was driven but the cart did not move (check the motor's supply and cable, free "
    "the cart)",
    Fault.CART_ENCODER: "the encoder of the cart does not answer, or something holds the cart (check the "
    "encoder's cable and the motor's supply, free the cart)",
    Fault.POLE_ENCODER: "the pole's encoder does not answer (check its cable)",
    Fault.HOMING: "homing failed: the cart did not move, or moved the wrong way, an end stop was not found, "
    "the distance of the end stops was off by over 3 %, or the pole did not come to rest (check the motor's "
    "supply, its direction and the cables of the motor and of the cart's encoder; clear the track, let the "
    "pole hang)",
}


def refusal(nack: Nack) -> PlantError:
    """Return the error for a NACK: FaultError for a latched fault, LinkError for delay, else RefusedError."""
    known = nack.type in MessageType.__members__.values()
    what = MessageType(nack.type).name if known else f"message {nack.type:#04x}"
    why = REASONS.get(nack.reason, f"reason {nack.reason}, unknown here")
    if (nack.type, nack.reason) == (MessageType.START_POLICY, Reason.UNKNOWN_TYPE):
        why = "its board has no policy: compile its firmware with one (docs/firmware.md)"
    text = f"the cart refused {what}: {why}"
    if nack.reason == Reason.FAULT_LATCHED:
        return FaultError(text)
    if nack.reason == Reason.STALE:
        return LinkError(text)
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
