"""cartpole-evaluate: run whole episodes of a trained agent, in simulation or on a cart.

run=lqr is energy and LQR, a controller without learning, as a baseline.

cartpole-evaluate run=runs/train/2026-11-21_12-00-00 episodes=20
cartpole-evaluate run=runs/train/2026-11-21_12-00-00 plant=emulated emulator.latency=0.02
cartpole-evaluate run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0
cartpole-evaluate run=pretrained/medium plant=emulated emulator.firmware=c emulator.policy=onboard
cartpole-evaluate run=lqr plant=emulated
cartpole-evaluate run=runs/train/<run> repeat.run=runs/evaluate/<run> repeat.episode=17

The last one repeats an episode of an earlier evaluation: the same simulated cart from the same start.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.commands.hydra_application.overrides import check_repetition
from cartpole_rl.workflows.checks import check_evaluation
from cartpole_rl.workflows.config import EvaluateConfig


@application("evaluate", EvaluateConfig)
def main(config: EvaluateConfig, folder: Path) -> None:
    """Check, then evaluate."""
    check_repetition(config)
    check_evaluation(config)
    from cartpole_rl.workflows.evaluate import evaluate

    evaluate(config, folder)


if __name__ == "__main__":
    main()
