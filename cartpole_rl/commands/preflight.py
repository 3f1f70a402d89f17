"""cartpole-preflight: small moves that tell whether a cart may be trusted with an agent.

cartpole-preflight plant.port=/dev/ttyUSB0
cartpole-preflight plant.port=auto
cartpole-preflight plant=emulated emulator.deadband_right=90
"""

from pathlib import Path

from cartpole_rl.commands.application import application
from cartpole_rl.workflows.config import PreflightConfig


@application("preflight", PreflightConfig)
def main(config: PreflightConfig, folder: Path) -> None:
    """A line for each check; exit code 1 after the first that is not OK."""
    from cartpole_rl.workflows.preflight import check_cart

    check_cart(config)


if __name__ == "__main__":
    main()
