"""cartpole-model: fit networks to what the identified physics leaves unexplained, and test them.

cartpole-model from=runs/record/2026-11-21_12-00-00
cartpole-model from=[runs/record/2026-11-21_12-00-00,runs/record/2026-11-21_12-30-00] seed=1

Every fifth recording is held out for the test. The resulting model is for plant=learned.
"""

from pathlib import Path

from cartpole_rl.commands.hydra_application.application import application
from cartpole_rl.workflows.checks import check_modelling
from cartpole_rl.workflows.config import ModelConfig


@application("model", ModelConfig)
def main(config: ModelConfig, folder: Path) -> None:
    """Check, then learn."""
    check_modelling(config)
    from cartpole_rl.workflows.model import learn_model

    learn_model(config, folder)


if __name__ == "__main__":
    main()
