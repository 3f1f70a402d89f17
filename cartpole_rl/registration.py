"""Tells Gymnasium which environments there are, without importing them.

``import cartpole_rl`` calls `register`, as Gymnasium expects of a package: after it, or in one go by
``gymnasium.make("cartpole_rl:cartpole_rl/SwingUp-v0")``, the environments are found by their names.
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
