"""Transforms of TorchRL above the hardware transform."""

from collections.abc import Callable

import pytest
from courses import course
from torchrl.envs import (
    CatFrames,
    Compose,
    FrameSkipTransform,
    InitTracker,
    RewardSum,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import ConfigError

TRANSFORMS: dict[str, Callable[[], Transform]] = {
    "RewardSum": RewardSum,
    "CatFrames": lambda: CatFrames(3, -1, in_keys=["observation"]),
    "InitTracker": InitTracker,
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_an_appended_transform_gives_what_a_nested_environment_gives(
    name: str, simulated: Callable[..., CartPoleEnv]
) -> None:
    def appended(transform: Transform) -> CartPoleEnv:
        env = simulated(4, {"seed": 7}, time_limit=20)
        hardware = env.hardware
        env.append_transform(transform)
        assert env.hardware is hardware
        return env

    check_env_specs(appended(TRANSFORMS[name]()))
    nested = TransformedEnv(simulated(4, {"seed": 7}, time_limit=20), TRANSFORMS[name]())
    for ours, theirs in zip(course(appended(TRANSFORMS[name]()), 50), course(nested, 50), strict=True):
        for mine, other in zip(ours, theirs, strict=True):
            assert {*mine.keys(True, True)} == {*other.keys(True, True)}
            assert (mine == other).all()


def test_a_frame_skip_is_refused(simulated: Callable[..., CartPoleEnv]) -> None:
    env = simulated(4)
    for add in (env.append_transform, lambda transform: env.insert_transform(0, transform)):
        for skip in (FrameSkipTransform(3), Compose(RewardSum(), FrameSkipTransform(3))):
            with pytest.raises(ConfigError, match="give a longer control_period"):
                add(skip)
