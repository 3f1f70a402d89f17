"""A compiled environment does what the plain one does, and what it gives out is its own."""

import shutil
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.ranges import Range
from cartpole_rl.tasks.settings import Start, StartSettings

CARTS, STEPS = 16, 25
ANYWHERE = StartSettings(
    angle=Start.ANY, position_spread=0.3, angle_spread=0, speed_spread=0.5, angular_speed_spread=1.0
)
RANGES = {"cart_mass": Range(relative=(-0.2, 0.2)), "angle_noise": Range(absolute=(1e-3, 1e-2))}

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler: install g++")


@pytest.fixture(
    params=["history", *(pytest.param(name, marks=pytest.mark.nightly) for name in ("raw", "positions"))]
)
def course(
    request: pytest.FixtureRequest,
    make_plant: Callable[..., SimulatedPlant],
    make_environment: Callable[..., CartPoleEnv],
) -> Callable[[bool], list[TensorDictBase]]:
    """Transitions under the same actions, compiled or not, with resets on the way."""
    observation: dict[str, Any] = {
        "history": {"pole_length": True},
        "raw": {"kind": "raw", "past_motors": 0, "past_velocities": 0},
        "positions": {"kind": "positions", "past_motors": 3, "past_velocities": 0, "past_positions": 2},
    }[request.param]

    def run(compiled: bool) -> list[TensorDictBase]:
        plant = make_plant(CARTS, ranges=RANGES, start=ANYWHERE, compiled=compiled)
        env = make_environment(plant, time_limit=10, **observation)
        generator = torch.Generator().manual_seed(0)
        present, taken = env.reset(), []
        for _ in range(STEPS):
            present["action"] = torch.randint(3, (CARTS,), generator=generator)
            transition, present = env.step_and_maybe_reset(present)
            taken.append(transition)
        return taken

    return run


def test_equals_the_plain_environment_and_overwrites_no_earlier_result(
    course: Callable[[bool], list[TensorDictBase]],
) -> None:
    taken = course(True)
    for earlier, later in pairwise(taken):
        going_on = ~earlier["next", "done"].squeeze(-1)
        for key in ("observation", "state", "past", "counts", "step_count"):
            assert torch.equal(earlier["next", key][going_on], later[key][going_on])
    plain, compiled = torch.stack(course(False)), torch.stack(taken)
    assert set(plain.keys(True, True)) == set(compiled.keys(True, True))
    for key in plain.keys(True, True):
        assert plain[key].dtype == compiled[key].dtype
    for key in (("next", "done"), ("next", "step_count"), "action"):
        assert torch.equal(plain[key], compiled[key])
    counts = (plain["next", "counts"] - compiled["next", "counts"]).abs()
    assert counts.max() <= 1  # where the last digit decides how a count is rounded
    assert (counts > 0).float().mean() < 0.01
    same = (counts == 0).all(-1) & (plain["counts"] == compiled["counts"]).all(-1)
    for key in ("state", "reward", "score"):
        torch.testing.assert_close(
            plain["next", key][same], compiled["next", key][same], rtol=1e-5, atol=1e-5
        )
