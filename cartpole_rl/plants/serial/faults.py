"""Clearing latched faults: a cart that stopped itself moves again only after a person has confirmed."""

import logging
from collections.abc import Callable

from cartpole_rl.errors import FaultError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.errors import fault_words

LOGGER = logging.getLogger(__name__)

Confirm = Callable[[str], bool]  # shows a person the text; True if the person says that the cart may move


def nobody(text: str) -> bool:
    """Never confirm: there is no person to ask."""
    return False


def always(text: str) -> bool:
    """Always confirm: for a cart that cannot be damaged."""
    return True


class FaultClearing:
    """Clears latched faults after a person has confirmed, or the first `unattended` ones without asking."""

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
            "check the cart, then start again in a terminal and confirm; for unattended work, "
            "plant.clear_faults=3 clears three faults without asking"
        )
