"""cartpole-emulate: run the emulated cart until it is interrupted."""

from cartpole_rl.choices import choice
from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.rig.hardware import RigSettings, nominal_hardware, parameters_of
from cartpole_rl.terminal import print_message


class EmulateConfig(RigSettings):
    """The settings of cartpole-emulate."""

    emulator: EmulatorSettings


def emulate(config: EmulateConfig) -> None:
    """Run the cart; it prints one line of JSON when it is ready. Raises EmulatorError if it cannot run."""
    from cartpole_rl.emulator.device import run  # imports MuJoCo

    of_ip02 = config.hardware == nominal_hardware()
    if of_ip02 and parameters_of(config.cart) != parameters_of(choice("cart/ip02")):
        print_message(
            "emulate",
            "note: with the encoders and track of ip02 the emulated cart keeps its own masses, friction and "
            "motor; set them, as emulator.cart_mass=0.9",
        )
    run(config.emulator.of_cart(config.cart))
