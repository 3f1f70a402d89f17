"""Train a cart-pole agent in simulation, drive a serial cart with it, and fine-tune it there.

``docs/house.md`` describes the layers and their imports. Importing the package registers its environments
with Gymnasium.
"""

from cartpole_rl.registration import register_with_gymnasium

__version__ = "0.1.0"

register_with_gymnasium()
