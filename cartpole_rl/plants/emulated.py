"""The plant on an emulated cart.

Nothing but the port's name comes from the emulator: what drives it is the same code that drives a real cart.
"""

from collections.abc import Callable
from typing import Literal

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.emulated_cart import EmulatedCart
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.serial.settings import SerialPlantSettings


def emulated_plant(
    emulator: EmulatorSettings,
    control_period: float = 0.02,
    prompt: Callable[[str], None] = lambda text: None,
    rehome: Literal["once", "always"] = "once",
) -> SerialPlant:
    """A serial plant on an emulated cart that lives as long as the plant. The start is the emulator's.

    Without disturbed frames the host is in no hurry to repeat a question, so that a busy computer does not
    add a period to a lockstep run, which is then repeatable; with them, a lost answer costs little time.
    """
    cart = EmulatedCart(emulator)
    disturbed = bool(emulator.frame_loss or emulator.frame_corruption or emulator.frame_reordering)
    settings = SerialPlantSettings(
        port=cart.port,
        start=emulator.start,
        control_period=control_period,
        rehome=rehome,
        timeout=5.0,
        connect_timeout=10.0,
        answer_timeout=0.1 if disturbed else 2.0,
        nudge_after=2.0,
        retries=20 if disturbed else 2,
        pole_length=2 * emulator.pole_com,
        clear_faults=None,
    )
    return SerialPlant(settings, prompt, owned=cart)
