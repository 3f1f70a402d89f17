"""The settings of run=lqr: energy and LQR, a controller without learning."""

import hydra

from cartpole_rl.checking import checked
from cartpole_rl.commands.composition import as_mapping
from cartpole_rl.workflows.config import TrainConfig


def baseline_training() -> TrainConfig:
    """Return a training on the nominal cart. To be called within a command, where Hydra has found conf/."""
    composed = hydra.compose("train", ["observation=raw", "observation.past_motors=1"])
    return checked(TrainConfig, as_mapping(composed))
