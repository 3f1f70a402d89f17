"""The environment is the same over a simulated and over a serial cart: same specs, same observations."""

import contextlib
from collections.abc import Callable

from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
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


def specs(env: EnvBase) -> tuple:
    return env.input_spec, env.output_spec
