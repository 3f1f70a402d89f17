"""Check a cart by small moves before an agent drives it."""

from collections.abc import Iterator
from contextlib import closing, contextmanager

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.preflight import Finding, preflight
from cartpole_rl.plants.serial.preparation import FaultClearing, always
from cartpole_rl.randomization.poles import Pole, one_pole
from cartpole_rl.terminal import confirm
from cartpole_rl.workflows.config import PreflightConfig
from cartpole_rl.workflows.poles import POLES, emulator_for, plant_words


def check_cart(config: PreflightConfig) -> None:
    """Check the cart of `config.plant` by small moves, and print a line for each check.

    At the end prints the command that balances the pole. Writes no files. Raises PlantError after the first
    check that fails, LinkError if no cart answers.
    """
    faults = FaultClearing(config.plant.clear_faults, confirm if config.plant.can_be_damaged else always)
    with connected_cart(config) as cart:
        finding: Finding | None = None
        for finding in preflight(cart, faults):
            print(finding, flush=True)
    if finding is None or not finding.ready:
        raise PlantError(
            f"the cart is not ready: {finding.check if finding else 'nothing was checked'} failed"
        )
    print("The cart is ready. Next, hold the pole up when asked (pretrained/large is for one of 0.66 m):")
    print(next_command(config))


def next_command(config: PreflightConfig) -> str:
    """Return the command that balances the pole on the same cart, with an agent for its length."""
    plant = plant_words(config.plant, config.emulator)
    return f"cartpole-evaluate run=pretrained/{mounted_pole(config)} task=balance {plant} episodes=1"


def mounted_pole(config: PreflightConfig) -> str:
    """Return the one of POLES that is about as long as the cart's; the default if there is none."""
    length = config.plant.known_pole_length(config.emulator)
    return (length and emulator_for([one_pole(Pole.rod(length))])) or POLES[0]


@contextmanager
def connected_cart(config: PreflightConfig) -> Iterator[SerialCart]:
    """Yield the cart, not open yet; disarm and close it at the end, and stop an emulated one."""
    with config.plant.reachable(config.emulator) as settings, closing(SerialCart(settings)) as cart:
        yield cart
