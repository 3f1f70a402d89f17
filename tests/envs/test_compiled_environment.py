"""A compiled environment does what the plain one does, and what it gives out is its own."""

import shutil
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from courses import ANYWHERE, course

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.randomization.ranges import Range

RANGES = {"cart_mass": Range(relative=(-0.2, 0.2)), "angle_noise": Range(absolute=(1e-3, 1e-2))}

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler: install g++")


OBSERVATIONS: dict[str, dict[str, Any]] = {
    "history": {"pole_length": True},
    "raw": {"kind": "raw", "past_motors": 0, "past_velocities": 0},
    "positions": {"kind": "positions", "past_motors": 3, "past_velocities": 0, "past_positions": 2},
}


@pytest.mark.parametrize(
    "kind", ["history", *(pytest.param(each, marks=pytest.mark.nightly) for each in ("raw", "positions"))]
)
def test_equals_the_plain_environment_and_overwrites_no_earlier_result(
    kind: str, simulated: Callable[..., CartPoleEnv]
) -> None:
    runs = []
    for compile_it in (False, True):
        plant = {"ranges": RANGES, "start": ANYWHERE, "compiled": compile_it}
        env = simulated(16, plant, time_limit=10, **OBSERVATIONS[kind])
        runs.append([transition for transition, _ in course(env, 25)])
    for earlier, later in pairwise(runs[1]):
        going_on = ~earlier["next", "done"].squeeze(-1)
        for key in ("observation", "state", "past", "counts", "step_count"):
            assert torch.equal(earlier["next", key][going_on], later[key][going_on])
    plain, compiled = map(torch.stack, runs)
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
