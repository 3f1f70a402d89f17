"""cartpole-finetune: train an agent further on the cart that it drives.

cartpole-finetune run=runs/train/2026-11-21_12-00-00 plant=serial plant.port=/dev/ttyUSB0 episodes=20
cartpole-finetune run=runs/train/2026-11-21_12-00-00 plant=emulated emulator.cart_viscous=2
cartpole-finetune resume=runs/finetune/2026-11-21_12-30-00

Three stages: episodes without exploration (before), episodes to learn from (tune), episodes without
exploration (after). One process drives the cart while this one learns, or another machine (learner=ray). Each
episode is written to disk before the next one starts, so Ctrl-C, a power cut or a pulled cable loses at most
the current episode.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.commands.hydra_application.overrides import check_resumption, is_given
from cartpole_rl.workflows.checks import check_finetuning
from cartpole_rl.workflows.config import FinetuneConfig


@application("finetune", FinetuneConfig)
def main(config: FinetuneConfig, folder: Path) -> None:
    """Check, then fine-tune."""
    if config.resume is None:
        check_finetuning(config)
    else:
        check_resumption("finetune", config.resume, folder, ("learner",))
    from cartpole_rl.workflows.finetune import finetune

    finetune(config, folder, new_learner=is_given("learner"))


if __name__ == "__main__":
    main()
