"""TorchRL environments over either plant: the hardware transform, and what puts the two together."""

from cartpole_rl.envs.hardware import HardwareTransform, ObservationSettings, TaskSettings
from cartpole_rl.envs.make import CartPoleEnv, make_env

__all__ = ["CartPoleEnv", "HardwareTransform", "ObservationSettings", "TaskSettings", "make_env"]
