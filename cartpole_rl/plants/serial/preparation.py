"""Preparing an episode: clear faults, find the middle of the track, set the period, wait for the pole.

The first preparation homes the cart; later ones bring it back to the middle, which is quicker. After a fault,
a restart or a lost link the zeros may be wrong, and the cart is homed again.
"""

import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from cartpole_rl.errors import FaultError, LinkError, PlantError
from cartpole_rl.plants.serial.cart import RESTARTED, SerialCart
from cartpole_rl.plants.serial.errors import LateError, fault_words
from cartpole_rl.plants.serial.link import now
from cartpole_rl.plants.serial.moves import recentre
from cartpole_rl.plants.settings import BoardSettings
from cartpole_rl.rig.hardware import Hardware
from cartpole_rl.wire.messages import Flags, microseconds_between

LOGGER = logging.getLogger(__name__)

OFF_CENTRE = 0.1  # of the half track: an episode starts no farther from the middle
STILL_SECONDS = 0.3  # by the cart's clock, for which the pole has to stay

BY_HAND = "put the cart in the middle of its track and let the pole hang still"
StartPosition = Literal["hanging", "upright"]
Confirm = Callable[[str], bool]  # shows a person the text; True if the person says that the cart may move


@dataclass(frozen=True)
class PolePosition:
    """A position of the pole at the start of an episode. Angles in rad, 0 upright."""

    angle: float
    tolerance: float
    sway: float  # largest minus smallest angle of a pole that counts as still
    remedy: str  # if the pole does not get there


POSITIONS: dict[StartPosition, PolePosition] = {
    "upright": PolePosition(
        0.0,
        math.radians(3),
        math.radians(1.5),  # a hand is never quite still
        "hold it up by hand until the cart begins to move",
    ),
    "hanging": PolePosition(
        math.pi,
        math.radians(5),
        math.radians(1),  # homing accepts 0.7 degrees
        "let it hang until it is still; it may not be touched during homing",
    ),
}


def nobody(text: str) -> bool:
    """Never confirm: there is no person to ask."""
    return False


def always(text: str) -> bool:
    """Always confirm: for a cart that cannot be damaged."""
    return True


def asking(board: BoardSettings, hardware: Hardware, confirm: Confirm) -> Callable[[], None]:
    """Return what is done before a board homes: say what it lacks, once, and ask for the cart by hand.

    That raises PlantError if nobody confirms.
    """
    lacks = [f"its board tells no rig; it is taken for one of {hardware.scales_text}", *board.lacks]

    def ask() -> None:
        while lacks:
            LOGGER.warning("plant=%s: %s", board.kind, lacks.pop(0))
        if board.homing == "hand" and not confirm(BY_HAND[0].upper() + BY_HAND[1:]):
            raise PlantError(
                f"plant.homing=hand: a person has to {BY_HAND} and confirm in a terminal; a board that homes "
                "by itself needs plant.homing=board"
            )

    return ask


class FaultClearing:
    """Clears latched faults after a person has confirmed, or the first `unattended` ones without asking.

    A cart that stopped itself moves again only then.
    """

    def __init__(self, unattended: int, confirm: Confirm = nobody) -> None:
        self.unattended = unattended
        self.cleared = 0  # faults cleared without asking
        self._confirm = confirm

    def clear(self, cart: SerialCart, fault: int) -> None:
        """Clear the latched `fault` bits of the cart.

        Raises FaultError if no person confirms, or if the cause of a fault persists.
        """
        words = f"the cart latched a fault: {fault_words(fault)}"
        if self.cleared < self.unattended:
            self.cleared += 1
            LOGGER.warning("%s; cleared without asking, %s of %s", words, self.cleared, self.unattended)
        elif not self._confirm(words):
            raise FaultError(f"{words}; {self._remedy()}")
        cart.clear_fault()

    def _remedy(self) -> str:
        if self.unattended:
            return f"{self.cleared} faults were cleared unattended (plant.clear_faults): check the cart"
        return (
            "check the cart, then confirm in a terminal that it may move; for unattended work, "
            "plant.clear_faults=3 clears three faults without asking"
        )


class Preparation:
    """Prepares episodes on a connected cart. `prompt` shows a person what to do."""

    def __init__(
        self,
        cart: SerialCart,
        start: StartPosition,
        control_period: float,
        faults: FaultClearing,
        prompt: Callable[[str], None],
    ) -> None:
        self.start: StartPosition = start
        self.control_period = control_period  # s
        self._cart = cart
        self._faults = faults
        self._prompt = prompt
        self._hanging: int | None = None  # pole count at rest after homing; None if the cart has to be homed

    def require_homing(self) -> None:
        """Home in the next preparation, as the zeros may be wrong."""
        self._hanging = None

    def prepare(self) -> None:
        """Bring the cart to the middle and wait for the pole; the cart is disarmed.

        Raises FaultError for a fault that does not clear or that no one agrees to clear, or for a homing that
        fails; PlantError if the pole does not reach its position in time; LinkError.
        """
        restarts = self._cart.restarts
        try:
            self._prepare_once()
        except PlantError:
            if self._cart.restarts == restarts:
                raise
            self.require_homing()
            self._prepare_once()  # a cart that restarts twice is given up

    def _prepare_once(self) -> None:
        self._clear_faults()
        if not self._recentred():
            self.require_homing()
            self._hanging = self._cart.home().pole_counts
        period_us = round(self.control_period * 1e6)
        if self._cart.info().period_us != period_us:  # the cart may have restarted since it was last asked
            self._cart.set_period(period_us)
        self._cart.get_state()  # read before the next question, so that a lockstep run is repeatable
        if self.start == "upright":
            self._prompt("Hold the pole upright and still; let go when the cart begins to move.")
        self._await_pole(POSITIONS[self.start])

    def _clear_faults(self) -> None:
        """Clear latched faults if there are any and a person confirms. Raises FaultError."""
        if fault := self._cart.poll_state().fault:
            self.require_homing()
            self._faults.clear(self._cart, fault)

    def _recentred(self) -> bool:
        """Bring the cart to the middle without homing; False if it has to be homed. Raises LinkError."""
        homed = bool(self._cart.flags & Flags.HOMED)
        if self._cart.settings.rehome == "always" or self._hanging is None or not homed:
            return False
        try:
            recentre(self._cart, self._hanging)
        except PlantError as error:
            if isinstance(error, LinkError) and not isinstance(error, LateError):
                raise
            LOGGER.warning("homing, as the cart could not be brought back to the middle: %s", error)
            self._clear_faults()
            return False
        return True

    def _await_pole(self, position: PolePosition) -> None:
        """Wait until the pole stays still in the position, and the cart near the middle.

        A hand that lifts the pole can move the cart. Raises PlantError after `start_timeout`.
        """
        timeout = self._cart.settings.start_timeout
        window: deque[tuple[int, float]] = deque()  # (us, rad) of the last STILL_SECONDS
        deadline = now() + timeout
        hardware = self._cart.hardware
        farthest = hardware.encoders.cart_counts(OFF_CENTRE * hardware.half_span)
        while True:
            state = self._cart.poll_state()
            if not self._cart.flags & Flags.HOMED:
                raise LinkError(RESTARTED)
            pole = 2 * math.pi * state.pole_counts / self._cart.information.pole_counts_per_turn
            off = math.remainder(pole - position.angle, 2 * math.pi)
            window.append((state.time_us, pole))
            angles = [angle for _, angle in window]
            away, sway = abs(state.cart_counts) > farthest, max(angles) - min(angles)
            if away or abs(off) > position.tolerance or sway > position.sway:
                window.clear()
            elif microseconds_between(window[0][0], state.time_us) >= STILL_SECONDS * 1e6:
                return
            if now() > deadline:
                millimetres = 1e3 * hardware.encoders.metres * state.cart_counts
                raise PlantError(
                    f"the cart is {millimetres:+.0f} mm from the middle of its track: bring it back by hand, "
                    "and hold only the pole"
                    if away
                    else f"waited {timeout:g} s for the pole to be still within "
                    f"{math.degrees(position.tolerance):.0f} deg of {self.start}; "
                    f"it is {math.degrees(off):+.1f} deg off: {position.remedy}"
                )
