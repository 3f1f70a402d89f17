"""The environment is the same over a simulated and over a serial cart: same specs, same observations."""

import contextlib
from collections.abc import Callable, Iterator

import pytest
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.plants.serial.plant import SerialPlant, emulated_plant
from cartpole_rl.plants.simulated import SimulatedPlant

MakePlant = Callable[..., SimulatedPlant]
MakeEnvironment = Callable[..., CartPoleEnv]


@pytest.fixture(scope="module")
def serial() -> Iterator[SerialPlant]:
    with contextlib.closing(emulated_plant(EmulatorSettings(physics_step=1e-3))) as plant:
        yield plant


@pytest.fixture(scope="module")
def over_serial(serial: SerialPlant, make_environment: MakeEnvironment) -> CartPoleEnv:
    return make_environment(serial, pole_length=True, past_motors=2, past_velocities=2)


@pytest.fixture(scope="module")
def over_simulated(make_plant: MakePlant, make_environment: MakeEnvironment) -> CartPoleEnv:
    return make_environment(make_plant(), pole_length=True, past_motors=2, past_velocities=2)


def specs(env: EnvBase) -> tuple:
    return env.input_spec, env.output_spec


def test_both_plants_have_the_same_specs(serial: SerialPlant, make_plant: MakePlant) -> None:
    assert specs(serial) == specs(make_plant())


def test_both_environments_have_the_same_specs(over_serial: CartPoleEnv, over_simulated: CartPoleEnv) -> None:
    assert specs(over_serial) == specs(over_simulated)


def test_specs_hold(over_serial: CartPoleEnv, over_simulated: CartPoleEnv) -> None:
    check_env_specs(over_simulated)
    check_env_specs(over_serial)
