"""cartpole-distill: train a small network to drive as an agent does, for a small processor.

cartpole-distill run=runs/train/2026-11-21_12-00-00
cartpole-distill run=pretrained/medium hidden=[16,16]

The result is an agent like any other: cartpole-evaluate and cartpole-export take it as run=.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.checks import check_agent
from cartpole_rl.workflows.config import DistillConfig


@application("distill", DistillConfig)
def main(config: DistillConfig, folder: Path) -> float:
    """Check, then distill; return the score, which a sweeper maximizes."""
    check_agent(config.run)
    from cartpole_rl.workflows.distill import distill

    return distill(config, folder)


if __name__ == "__main__":
    main()
