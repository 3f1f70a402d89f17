"""Check a cart by small moves before an agent drives it."""

from collections.abc import Iterator
from contextlib import closing, contextmanager

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.emulated_cart import EmulatedCart
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.faults import FaultClearing, always
from cartpole_rl.plants.serial.preflight import Finding, preflight
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.plants.settings import EmulatedSettings
from cartpole_rl.workflows.config import PreflightConfig
from cartpole_rl.workflows.person import confirm
from cartpole_rl.workflows.results import plant_words


def check_cart(config: PreflightConfig) -> None:
    """Check the cart of `config.plant` by small moves, and print a line for each check.

    Writes no files. Raises PlantError after the first check that fails, LinkError if no cart answers.
    """
    with connected_cart(config) as cart:
        finding: Finding | None = None
        for finding in preflight(cart, fault_clearing(config.plant)):
            print(finding, flush=True)
    if finding is None or not finding.ready:
        raise PlantError(
            f"the cart is not ready: {finding.check if finding else 'nothing was checked'} failed"
        )
    print("The cart is ready. Next:")
    print(f"cartpole-identify {plant_words(config.plant)}")


def fault_clearing(plant: EmulatedSettings | SerialSettings) -> FaultClearing:
    """Return the rule for clearing latched faults."""
    if isinstance(plant, SerialSettings):
        return FaultClearing(plant.clear_faults, confirm)
    return FaultClearing(0, always)


@contextmanager
def connected_cart(config: PreflightConfig) -> Iterator[SerialCart]:
    """Yield the cart, not open yet; disarm and close it at the end, and stop an emulated one."""
    if isinstance(config.plant, SerialSettings):
        with closing(SerialCart(config.plant)) as cart:
            yield cart
        return
    truth = config.emulator.model_copy(update={"start": "hanging"})
    with EmulatedCart(truth) as emulated, closing(SerialCart(emulated.settings)) as cart:
        yield cart
