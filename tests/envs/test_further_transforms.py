"""Transforms of TorchRL above the hardware transform."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import (
    CatFrames,
    EnvBase,
    InitTracker,
    RewardSum,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.plants.simulated import SimulatedPlant

CARTS, STEPS, LIMIT = 4, 50, 20
TRANSFORMS: dict[str, Callable[[], Transform]] = {
    "RewardSum": RewardSum,
    "CatFrames": lambda: CatFrames(3, -1, in_keys=["observation"]),
    "InitTracker": InitTracker,
}


def course(env: EnvBase) -> list[tuple[TensorDictBase, TensorDictBase]]:
    """Return the result of each step under actions that move the carts."""
    generator = torch.Generator().manual_seed(0)
    present, results = env.reset(), []
    for _ in range(STEPS):
        present["action"] = torch.randint(3, (CARTS,), generator=generator)
        transition, present = env.step_and_maybe_reset(present)
        results.append((transition.clone(), present.clone()))
    return results


@pytest.mark.parametrize("name", TRANSFORMS)
def test_an_appended_transform_gives_what_a_nested_environment_gives(
    name: str,
    make_plant: Callable[..., SimulatedPlant],
    make_environment: Callable[..., CartPoleEnv],
) -> None:
    def bare() -> CartPoleEnv:
        return make_environment(make_plant(CARTS, seed=7), time_limit=LIMIT)

    checked = bare()
    hardware = checked.hardware
    checked.append_transform(TRANSFORMS[name]())
    assert checked.hardware is hardware
    check_env_specs(checked)

    appended = bare()
    appended.append_transform(TRANSFORMS[name]())
    nested = TransformedEnv(bare(), TRANSFORMS[name]())
    for ours, theirs in zip(course(appended), course(nested), strict=True):
        for mine, other in zip(ours, theirs, strict=True):
            assert {*mine.keys(True, True)} == {*other.keys(True, True)}
            assert (mine == other).all()
