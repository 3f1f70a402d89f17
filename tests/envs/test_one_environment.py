"""The environment is the same over a simulated and over a serial cart: same specs, same observations."""

import contextlib
from collections.abc import Callable, Iterator

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from cartpole_rl.emulator.settings import EmulatorSettings
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.plants.serial.plant import SerialPlant, emulated_plant
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.plants.specs import Plant, PlantOutput

MakePlant = Callable[..., SimulatedPlant]
MakeEnvironment = Callable[..., CartPoleEnv]
SEEN = ("state", "past", "observation", "reward", "score", "score_upright", "step_count", "done")
STEPS = 40


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


class RecordedPlant(Plant):
    """Carts that all report a given recording."""

    def __init__(self, frames: TensorDictBase, carts: int, length: float) -> None:
        super().__init__(carts)
        self._frames, self._length, self._next = frames, length, 0

    @property
    def pole_length(self) -> Tensor:
        return torch.full((self.carts,), self._length)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDict:
        self._next = 0
        return self.first_output(self._read())

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        return self.output(self._read())

    def _read(self) -> PlantOutput[Tensor]:
        frame = self._frames[self._next]
        self._next += 1
        return PlantOutput(*(frame[key].expand(self.carts, -1).clone().T for key in PlantOutput._fields))

    def _set_seed(self, seed: int | None) -> None: ...


def drive(env: CartPoleEnv, actions: Tensor) -> list[TensorDictBase]:
    """The frame of the reset and those of the steps."""
    present = env.reset()
    frames = [present.clone()]
    for action in actions:
        following = env.step(present.set("action", action.expand(env.plant.carts)))["next"]
        frames.append(following.clone())
        present = following.exclude("reward")
    return frames


def specs(env: EnvBase) -> tuple:
    return env.input_spec, env.output_spec


def test_both_plants_have_the_same_specs(serial: SerialPlant, make_plant: MakePlant) -> None:
    assert specs(serial) == specs(make_plant())


def test_both_environments_have_the_same_specs(over_serial: CartPoleEnv, over_simulated: CartPoleEnv) -> None:
    assert specs(over_serial) == specs(over_simulated)


def test_specs_hold(over_serial: CartPoleEnv, over_simulated: CartPoleEnv) -> None:
    check_env_specs(over_simulated)
    check_env_specs(over_serial)


@pytest.mark.parametrize("carts", [1, 3])
@pytest.mark.parametrize("source", ["over_serial", "over_simulated"])
def test_the_same_counts_give_the_same_observations(
    request: pytest.FixtureRequest, make_environment: MakeEnvironment, source: str, carts: int
) -> None:
    """Counts of either cart, replayed by a third plant, give the same observations, alone and in a batch."""
    env: CartPoleEnv = request.getfixturevalue(source)
    actions = torch.randint(3, (STEPS,), generator=torch.Generator().manual_seed(0))
    original = drive(env, actions)
    recorded = torch.stack([frame.select(*PlantOutput._fields) for frame in original])
    plant = RecordedPlant(recorded[:, 0], carts, env.plant.pole_length.item())
    again = drive(make_environment(plant, pole_length=True, past_motors=2, past_velocities=2), actions)
    for first, second in zip(original, again, strict=True):
        for key in SEEN:
            if key in first:
                assert (first[key] == second[key]).all(), key
    assert len(torch.stack([frame["counts"] for frame in original]).unique()) > STEPS
