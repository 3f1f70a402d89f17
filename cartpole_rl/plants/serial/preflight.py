"""The preflight: checks in order; each relies only on checks that passed before."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.serial import checks
from cartpole_rl.plants.serial.cart import RESTARTED, SerialCart
from cartpole_rl.plants.serial.faults import FaultClearing
from cartpole_rl.plants.serial.probe import Probe


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    check: str
    ready: bool
    words: str

    def __str__(self) -> str:
        return f"{'OK ' if self.ready else 'BAD'}  {self.check}: {self.words}"


def preflight(cart: SerialCart, faults: FaultClearing | None = None) -> Iterator[Finding]:
    """Check a cart, which need not be open yet, and yield a finding for each check.

    Ends after the first check that fails. The cart is disarmed at the end, and left open. Errors of the link
    and faults of the cart are findings too. `faults` decides whether a latched fault may be cleared; without
    it none is.
    """
    try:
        for name, check in _checks(cart, faults or FaultClearing(0)).items():
            finding = _finding(name, check, cart)
            yield finding
            if not finding.ready:
                return
    finally:
        if cart.is_open:
            with suppress(PlantError):  # the finding says why; the cart's watchdog stops it
                cart.stop()


def _checks(cart: SerialCart, faults: FaultClearing) -> dict[str, Callable[[], str]]:
    probe = Probe(cart)
    return {
        "link": lambda: checks.link(cart),
        "limits": lambda: checks.limits(cart.information),
        "homing": lambda: checks.homing(cart, faults),
        "cart encoder": lambda: checks.cart_direction(probe),
        "pole encoder": lambda: checks.pole_direction(probe),
        "dead-band": lambda: checks.deadband(probe),
        "latency": lambda: checks.latency(probe),
        "soft limit": lambda: checks.soft_limit(probe),
    }


def _finding(name: str, check: Callable[[], str], cart: SerialCart) -> Finding:
    restarts = cart.restarts
    try:
        finding = Finding(name, True, check())
    except PlantError as error:
        finding = Finding(name, False, str(error))
    return finding if cart.restarts == restarts else Finding(name, False, RESTARTED)
