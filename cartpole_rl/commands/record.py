"""cartpole-record: run whole episodes as cartpole-evaluate does, and write a recording of each.

cartpole-record run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0 episodes=5
cartpole-record run=runs/train/2026-11-21_12-00-00 plant=emulated
cartpole-record run=lqr pole=large

A recording is written as soon as its episode ends, so Ctrl-C or a pulled cable loses at most the current
episode. Simulated carts run side by side, and end together.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.commands.hydra_application.overrides import check_repetition
from cartpole_rl.workflows.checks import check_evaluation
from cartpole_rl.workflows.config import RecordConfig


@application("record", RecordConfig)
def main(config: RecordConfig, folder: Path) -> None:
    """Check, then record."""
    check_repetition(config)
    check_evaluation(config)
    from cartpole_rl.workflows.record import record

    record(config, folder)


if __name__ == "__main__":
    main()
