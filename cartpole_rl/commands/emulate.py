"""cartpole-emulate: run the emulated cart until it is interrupted.

cartpole-emulate emulator.clock=real
cartpole-emulate emulator.latency=0.02 emulator.cart_coulomb_left=0.8
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.config import EmulateConfig


@application("emulate", EmulateConfig)
def main(config: EmulateConfig, folder: Path) -> None:
    """Run the cart; it prints one line of JSON when it is ready."""
    from cartpole_rl.emulator.process import run

    run(config.emulator)


if __name__ == "__main__":
    main()
