"""Episodes of simulated carts that are shaken."""

import torch
from tensordict import TensorDictBase

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.evaluation.episodes import run_batch
from cartpole_rl.tasks.episode import Episode

MOTORS = (-250, -150, 0, 150, 250)


def shaken(env: CartPoleEnv, hold: int = 10) -> list[Episode]:
    """An episode of each cart; each random action, of MOTORS, is held for `hold` periods."""
    random, held = torch.Generator().manual_seed(0), []

    def shake(present: TensorDictBase) -> TensorDictBase:
        again = len(held) % hold
        held.append(held[-1] if again else torch.randint(len(MOTORS), env.batch_size, generator=random))
        return present.set("action", held[-1])

    return run_batch(env, shake)
