"""The environment is the same over a simulated and over a serial cart: same specs, same observations."""

import contextlib
from collections.abc import Callable

import pytest
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.errors import ConfigError
from cartpole_rl.plants.serial.plant import emulated_plant


def test_specs_hold_and_are_those_of_the_other_plant(
    simulated: Callable[..., CartPoleEnv], make_environment: Callable[..., CartPoleEnv]
) -> None:
    observation = {"pole_length": True, "past_motors": 2, "past_velocities": 2}
    with contextlib.closing(emulated_plant(EmulatorSettings(physics_step=1e-3))) as plant:
        over_serial, over_simulated = make_environment(plant, **observation), simulated(**observation)
        assert specs(plant) == specs(over_simulated.plant)
        assert specs(over_serial) == specs(over_simulated)
        check_env_specs(over_simulated)
        check_env_specs(over_serial)


def test_no_environment_is_moved_to_another_device(simulated: Callable[..., CartPoleEnv]) -> None:
    """Its specs would move, its carts would not."""
    env = simulated()
    assert env.to("cpu").device == env.device
    with pytest.raises(ConfigError, match="the plant was made on cpu; make it on meta in place of moving it"):
        env.to("meta")


def specs(env: EnvBase) -> tuple:
    return env.input_spec, env.output_spec
