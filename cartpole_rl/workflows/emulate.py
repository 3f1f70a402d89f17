"""cartpole-emulate: run the emulated cart until it is interrupted."""

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.settings import RigSettings


class EmulateConfig(RigSettings):
    """The settings of cartpole-emulate."""

    emulator: EmulatorSettings


def emulate(config: EmulateConfig) -> None:
    """Run the cart; it prints one line of JSON when it is ready. Raises EmulatorError if it cannot run."""
    from cartpole_rl.emulator.process import run  # imports MuJoCo

    run(config.emulator.of_cart(config.cart))
