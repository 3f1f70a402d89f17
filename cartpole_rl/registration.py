"""Tells Gymnasium which environments there are, without importing them.

Gymnasium calls `register` by itself where this package is installed (the entry point `gymnasium.envs` in
pyproject.toml), so that ``gymnasium.make("cartpole_rl/SwingUp-v0")`` needs no import.
"""

import gymnasium

ENVIRONMENTS = {"cartpole_rl/SwingUp-v0": "swingup", "cartpole_rl/Balance-v0": "balance"}  # id: task


def register() -> None:
    """Register what is not registered yet."""
    for name, task in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="cartpole_rl.envs.gymnasium:CartPoleGymnasium",
                vector_entry_point="cartpole_rl.envs.gymnasium:CartPoleVector",
                kwargs={"task": task},
            )
