"""cartpole-train: train an agent in randomized simulation.

cartpole-train experiment=medium seed=1
cartpole-train -m randomization=friction_3,friction_6,friction_12 seed=0,1
cartpole-train resume=runs/train/2026-11-21_12-00-00
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.commands.hydra_application.overrides import check_resumption
from cartpole_rl.workflows.checks import check_training
from cartpole_rl.workflows.config import TrainConfig


@application("train", TrainConfig)
def main(config: TrainConfig, folder: Path) -> float:
    """Check, then train; return the score, for Optuna."""
    if config.resume is None:
        check_training(config)
    else:
        check_resumption("train", config.resume, folder)
    from cartpole_rl.workflows.train import train

    return train(config, folder)


if __name__ == "__main__":
    main()
