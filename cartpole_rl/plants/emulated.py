"""The plant on an emulated cart.

Only the port's name comes from the emulator: the code that drives it is the code that drives a real cart.
"""

from collections.abc import Callable

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.emulated_cart import EmulatedCart
from cartpole_rl.plants.serial.faults import always
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.serial.settings import Rehome


def emulated_plant(
    emulator: EmulatorSettings,
    control_period: float = 0.02,
    prompt: Callable[[str], None] = lambda text: None,
    rehome: Rehome = "once",
) -> SerialPlant:
    """Return a serial plant on an emulated cart that lives as long as the plant.

    The pole's length and the start position are those of the emulator. Faults are cleared without asking.
    """
    cart = EmulatedCart(emulator)
    settings = cart.settings.model_copy(update={"rehome": rehome, "pole_length": 2 * emulator.pole_com})
    return SerialPlant(settings, emulator.start, control_period, prompt, owned=cart, confirm=always)
