"""Check a cart by small moves before an agent drives it."""

from contextlib import closing

from cartpole_rl.errors import PlantError
from cartpole_rl.plants.serial.cart import SerialCart
from cartpole_rl.plants.serial.preflight import Finding, preflight
from cartpole_rl.plants.serial.preparation import FaultClearing, always, asking
from cartpole_rl.plants.settings import BoardSettings, emulated_pole
from cartpole_rl.randomization.poles import Pole, one_pole
from cartpole_rl.rig.hardware import nominal_hardware
from cartpole_rl.terminal import confirm, words_given
from cartpole_rl.workflows.config import PreflightConfig
from cartpole_rl.workflows.poles import PRETRAINED, emulator_for, plant_words


def check_cart(config: PreflightConfig) -> None:
    """Check the cart of `config.plant` by small moves, and print a line for each check.

    At the end prints the next command. Writes no files. Raises PlantError after the first check that fails,
    LinkError if no cart answers.
    """
    plant, hardware = config.plant, config.hardware
    faults = FaultClearing(plant.clear_faults, confirm if plant.can_be_damaged else always)
    asked = asking(plant, hardware, confirm) if isinstance(plant, BoardSettings) else lambda: None
    finding: Finding | None = None
    with (
        plant.reachable(config.emulator.of_cart(config.cart), hardware) as (settings, server),
        closing(SerialCart(settings, hardware, asked, server)) as cart,  # disarmed and closed at the end
    ):
        for finding in preflight(cart, faults):
            print(finding, flush=True)
    if finding is None or not finding.ready:
        failed = finding.check if finding else "nothing was checked"
        raise PlantError(f"the cart is not ready: {failed} failed")
    if hardware == nominal_hardware():
        print("The cart is ready. Next, hold the pole up when asked (pretrained/large is for one of 0.66 m):")
    else:
        print("The cart is ready. Next, measure it; pretrained agents are for carts like cart=ip02:")
    print(next_command(config))


def next_command(config: PreflightConfig) -> str:
    """Return the command that balances the pole on the same cart, with an agent for its length.

    A cart that is not like ip02, which no pretrained agent knows, is identified first.
    """
    plant, pole = plant_words(config.plant, config.emulator), mounted_pole(config)
    if config.hardware == nominal_hardware():
        pole = pole if pole in PRETRAINED else PRETRAINED[0]
        return f"cartpole-evaluate run=pretrained/{pole} task=balance {plant} episodes=1"
    return " ".join(["cartpole-identify", *words_given("cart"), plant, f"pole={pole or '<yours>.yaml'}"])


def mounted_pole(config: PreflightConfig) -> str:
    """Return the one of POLES that is like the cart's; empty if there is none."""
    length = config.plant.known_pole_length(config.emulator)
    emulated = config.plant.reads_emulator
    pole = emulated_pole(config.emulator) if emulated else Pole.rod(length) if length else None
    return (pole and emulator_for([one_pole(pole)])) or ""
