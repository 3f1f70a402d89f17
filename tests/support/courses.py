"""Courses of many simulated carts under random actions, and where they start."""

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cartpole_rl.tasks.settings import Start, StartSettings


def scattered(angle: Start = Start.HANGING, **spreads: float) -> StartSettings:
    """Starts at exactly `angle`, at rest, in the middle, but for `spreads`."""
    none = dict.fromkeys(("position_spread", "angle_spread", "speed_spread", "angular_speed_spread"), 0.0)
    return StartSettings(angle=angle, **{**none, **spreads})


ANYWHERE = scattered(Start.ANY, position_spread=0.3, speed_spread=0.5, angular_speed_spread=1.0)


def course(env: EnvBase, steps: int) -> list[tuple[TensorDictBase, TensorDictBase]]:
    """Transitions and what follows them, after resets, under actions that are the same each time."""
    generator = torch.Generator().manual_seed(0)
    present, results = env.reset(), []
    for _ in range(steps):
        present["action"] = torch.randint(3, env.batch_size, generator=generator)
        transition, present = env.step_and_maybe_reset(present)
        results.append((transition.clone(recurse=False), present.clone(recurse=False)))  # the same tensors
    return results
