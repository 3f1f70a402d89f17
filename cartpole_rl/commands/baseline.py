"""The settings of run=lqr: energy and LQR, a controller that learned nothing."""

import hydra

from cartpole_rl.checking import checked
from cartpole_rl.commands.composition import as_mapping
from cartpole_rl.workflows.config import TrainConfig


def baseline_training() -> TrainConfig:
    """A training on the nominal cart of conf/. Only within a command, where Hydra knows conf/."""
    composed = hydra.compose("train", ["observation=raw", "observation.past_motors=1"])
    return checked(TrainConfig, as_mapping(composed))
