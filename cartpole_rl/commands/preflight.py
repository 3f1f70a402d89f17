"""cartpole-preflight: check a cart by small moves before an agent drives it.

cartpole-preflight plant=serial plant.port=/dev/ttyUSB0
cartpole-preflight plant=serial plant.port=auto
cartpole-preflight plant=emulated emulator.deadband_right=90
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.commands.hydra_application.overrides import given_in
from cartpole_rl.workflows.config import PreflightConfig


@application("preflight", PreflightConfig)
def main(config: PreflightConfig, folder: Path) -> None:
    """Print a line for each check; the exit code is 1 after the first that fails."""
    from cartpole_rl.workflows.preflight import check_cart

    check_cart(config, given_in("plant", "emulator"))


if __name__ == "__main__":
    main()
