"""Check a cart by small moves before an agent drives it."""

from collections.abc import Iterator
from contextlib import contextmanager

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.emulated_cart import EmulatedCart
from cartpole_rl.plants.serial.cart import SerialCart, SerialSettings
from cartpole_rl.plants.serial.faults import FaultClearing
from cartpole_rl.plants.serial.preflight import Finding, preflight
from cartpole_rl.workflows.config import EmulatedSettings, PreflightConfig, RealSettings
from cartpole_rl.workflows.person import confirm


def check_cart(config: PreflightConfig) -> None:
    """Print a line for each check. Raises PlantError after the first that is not OK."""
    with the_cart(config) as cart:
        finding: Finding | None = None
        for finding in preflight(cart, config.home_timeout, faults(config.plant)):
            print(finding, flush=True)
    if finding is None or not finding.ready:
        raise PlantError(
            f"the cart is not ready: {finding.check if finding else 'nothing was checked'} is off"
        )
    print("The cart is ready.")


def faults(plant: EmulatedSettings | RealSettings) -> FaultClearing:
    """The rule by which latched faults are cleared."""
    return FaultClearing(plant.clear_faults if isinstance(plant, RealSettings) else None, confirm)


@contextmanager
def the_cart(config: PreflightConfig) -> Iterator[SerialCart]:
    """The cart to check, not open yet; disarmed and closed at the end, and an emulated one ended."""
    if isinstance(config.plant, RealSettings):
        cart = SerialCart(SerialSettings(port=config.plant.port, baud=config.plant.baud))
        try:
            yield cart
        finally:
            cart.close()
        return
    with EmulatedCart(config.emulator.model_copy(update={"start": "hanging"})) as emulated:
        patient = SerialSettings(
            port=emulated.port, timeout=5, connect_timeout=10, answer_timeout=2, nudge_after=2
        )
        cart = SerialCart(patient)
        try:
            yield cart
        finally:
            cart.close()
