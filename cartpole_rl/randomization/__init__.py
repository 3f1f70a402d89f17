"""Nominal parameters and a generator in, a batch of drawn parameters out."""

from cartpole_rl.randomization.found import Draws, FoundCarts, FoundSettings
from cartpole_rl.randomization.poles import Pole, PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.ranges import Range

__all__ = ["Draws", "FoundCarts", "FoundSettings", "Pole", "PoleSettings", "Randomizer", "Range"]
