"""cartpole-identify: measure the parameters of a cart, by experiments or from recordings.

cartpole-identify plant=serial plant.port=/dev/ttyUSB0 pole=medium
cartpole-identify plant=emulated emulator.cart_viscous=2
cartpole-identify from=runs/identify/2026-11-21_12-00-00

Keep the track clear: the cart moves by itself for four minutes, and the pole swings all round. Each
experiment is written to disk before the next one starts, and the parameters are fitted to the files.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.checks import check_identification
from cartpole_rl.workflows.config import IdentifyConfig


@application("identify", IdentifyConfig)
def main(config: IdentifyConfig, folder: Path) -> None:
    """Check, then identify."""
    check_identification(config)
    from cartpole_rl.workflows.identify import identify_cart

    identify_cart(config, folder)


if __name__ == "__main__":
    main()
