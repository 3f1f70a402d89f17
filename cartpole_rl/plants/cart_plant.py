"""The plant on a cart behind a serial port, emulated or real, from its settings."""

from collections.abc import Callable

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.plants.emulated import emulated_plant
from cartpole_rl.plants.serial.faults import Confirm, nobody
from cartpole_rl.plants.serial.plant import SerialPlant
from cartpole_rl.plants.serial.preparation import StartPosition
from cartpole_rl.plants.serial.settings import SerialSettings
from cartpole_rl.plants.settings import EmulatedSettings


def cart_plant(
    plant: EmulatedSettings | SerialSettings,
    emulator: EmulatorSettings,
    control_period: float,
    start: StartPosition,
    prompt: Callable[[str], None],
    confirm: Confirm = nobody,
) -> SerialPlant:
    """Return the plant of plant=serial, or of plant=emulated on a new cart with the settings `emulator`.

    An emulated cart starts in the position `start` and needs nobody to confirm. Raises PortError, LinkError,
    NotReadyError, EmulatorError.
    """
    if isinstance(plant, EmulatedSettings):
        emulator = emulator.model_copy(update={"start": start})
        return emulated_plant(emulator, control_period, prompt, plant.rehome)
    return SerialPlant(plant, start, control_period, prompt, confirm=confirm)
