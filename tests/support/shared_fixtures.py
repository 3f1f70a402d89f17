"""Shared fixtures: the nominal cart and pole of conf/, and builders of carts, plants and environments.

Hypothesis sets no deadlines: no test fails because a machine is slow.

Torch takes one thread, here and in children: the work of a test is small, and threads would wait busily.
Hydra reads each file of conf/ once: reading them would take a third of the time of a composition.
A track guard is fitted to an eighth of the carts, but with `all_carts`; pictures are coarse.
"""

import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import files_read_once  # noqa: F401
import pytest
import torch
import yaml
from command_line import Once, no_pictures, same_handlers
from courses import scattered
from filelock import FileLock
from hypothesis import HealthCheck, settings

from cartpole_rl.envs import guard
from cartpole_rl.envs.build import known_guard_numbers, make_env
from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.settings import ObservationSettings, TrackGuard
from cartpole_rl.physics.models import Models
from cartpole_rl.physics.parameters import CartParameters
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.plants.specs import Plant
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.randomizer import Randomizer
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.registry import Registry
from cartpole_rl.reporting import style
from cartpole_rl.rig.hardware import parameters_of
from cartpole_rl.rig.parameters import PARAMETERS, completed
from cartpole_rl.tasks.settings import ActionSettings, RewardSettings, StartSettings, TaskSettings

CONF = Path(__file__).parents[2] / "conf"

os.environ["OMP_NUM_THREADS"] = "1"  # of children
torch.set_num_threads(1)
FITTED = guard.SAMPLES
guard.SAMPLES = FITTED // 8
style.DPI //= 3
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


def conf(choice: str) -> dict[str, Any]:
    """Return the content of a file of conf/."""
    return yaml.safe_load((CONF / f"{choice}.yaml").read_text())


@pytest.fixture(scope="session")
def ip02() -> dict[str, float]:
    """Nominal numbers of the cart, without a pole."""
    return parameters_of(conf("cart/ip02"))


@pytest.fixture(scope="session")
def medium() -> PoleSettings:
    return PoleSettings(**conf("pole/medium"))


@pytest.fixture(scope="session")
def nominal(ip02: dict[str, float], medium: PoleSettings) -> dict[str, float]:
    """Nominal numbers of the cart and the medium pole."""
    return {**ip02, **medium.nominal.model_dump()}


@pytest.fixture(scope="session")
def both_poles() -> PoleSettings:
    return PoleSettings(choices={**conf("pole/medium")["choices"], **conf("pole/large")["choices"]})


@pytest.fixture(scope="session")
def make_cart(ip02: dict[str, float], medium: PoleSettings) -> Callable[..., CartParameters]:
    """Carts in float64; each keyword replaces a nominal number, by a number or a tensor [N]."""

    def build(carts: int = 1, **changes: float | torch.Tensor) -> CartParameters:
        values = completed({**ip02, **medium.nominal.model_dump(), **changes})
        rows = [
            torch.as_tensor(values[name], dtype=torch.float64).expand(carts)
            for name in CartParameters.names()
        ]
        return CartParameters(torch.stack(rows))

    return build


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Let one worker fill a folder; every worker gets a copy of its own, and what `make` returned."""
    own = tmp_path_factory.getbasetemp()
    shared = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    shared.mkdir(exist_ok=True)

    def once(name: str, make: Callable[[Path], Any]) -> tuple[Path, Any]:
        folder, ended = shared / name, shared / f"{name}.pickle"
        with FileLock(shared / f"{name}.lock"):
            if not ended.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                ended.write_bytes(pickle.dumps(make(folder)))
        copy = shutil.copytree(folder, tmp_path_factory.mktemp(name), dirs_exist_ok=True)
        return copy / "run", pickle.loads(ended.read_bytes())

    return once


@pytest.fixture(scope="module")
def all_carts() -> Iterator[None]:
    """Fit track guards to as many carts as a command does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guard, "SAMPLES", FITTED)
        known_guard_numbers.cache_clear()
        yield
    known_guard_numbers.cache_clear()


@pytest.fixture
def without_pictures() -> Iterator[None]:
    with no_pictures():
        yield


@pytest.fixture
def same_signals() -> Iterator[None]:
    with same_handlers():
        yield


@pytest.fixture
def own_extensions() -> Iterator[None]:
    """Forget the extensions and parameters that a test registers."""
    before = {kind: {**registry._entries} for kind, registry in Registry.all.items()}
    parameters = {**PARAMETERS}
    yield
    for kind, registry in Registry.all.items():
        registry._entries = before.get(kind, registry._entries)
    for name in PARAMETERS.keys() - parameters.keys():
        del PARAMETERS[name]


STILL = scattered()


@pytest.fixture(scope="session")
def make_plant(ip02: dict[str, float], medium: PoleSettings) -> Callable[..., SimulatedPlant]:
    """Simulated carts that start hanging, at rest, in the middle, unless `start` is given."""

    def build(
        carts: int = 1,
        cart: dict[str, float] | None = None,
        poles: PoleSettings = medium,
        ranges: dict[str, Range] | None = None,
        start: StartSettings = STILL,
        models: Models = Models(),  # noqa: B008 - immutable
        kind: type[SimulatedPlant] = SimulatedPlant,
        **settings: Any,
    ) -> SimulatedPlant:
        randomizer = Randomizer({**ip02, **(cart or {})}, poles, ranges or {})
        return kind(carts, randomizer, start, models, **settings)

    return build


@pytest.fixture(scope="session")
def make_environment() -> Callable[..., CartPoleEnv]:
    """The swing-up over `plant`, each keyword in place of one of its settings."""

    def build(
        plant: Plant,
        motors: tuple[int, ...] = (-200, 0, 200),
        time_limit: int = 500,
        angle_limit: float | None = None,
        reward: dict[str, Any] | None = None,
        guard: TrackGuard | None = None,
        **observation: Any,
    ) -> CartPoleEnv:
        return make_env(
            plant,
            ActionSettings(motors=motors, actuator="force_curve"),
            TaskSettings(
                name="test",
                start=STILL,
                evaluation_start=STILL,
                time_limit=time_limit,
                angle_limit=angle_limit,
                x_max=0.38,
            ),
            ObservationSettings(**{**conf("observation/history"), **observation}),
            RewardSettings(**{**conf("reward/score"), **(reward or {})}),
            guard,
        )

    return build


@pytest.fixture(scope="session")
def simulated(make_plant: Callable[..., SimulatedPlant], make_environment: Callable[..., CartPoleEnv]) -> Any:
    """The swing-up over simulated carts; `plant` and the other keywords are those of the two builders."""

    def build(carts: int = 1, plant: dict[str, Any] | None = None, **environment: Any) -> CartPoleEnv:
        return make_environment(make_plant(carts, **(plant or {})), **environment)

    return build
