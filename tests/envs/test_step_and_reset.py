"""The environment's own step with resets does what TorchRL's does, key by key and to the bit."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from courses import ANYWHERE, course
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from cartpole_rl.envs.cart_pole_env import CartPoleEnv
from cartpole_rl.envs.hardware import HardwareTransform
from cartpole_rl.plants.simulated import SimulatedPlant
from cartpole_rl.randomization.poles import PoleSettings
from cartpole_rl.randomization.ranges import Range

CARTS, LIMIT = 32, 60
RANGES = {
    "cart_mass": Range(relative=(-0.2, 0.2)),
    "latency": Range(absolute=(0.0, 0.03)),
    "latency_jitter": Range(absolute=(0.001, 0.005)),
    "position_noise": Range(absolute=(1e-5, 1e-4)),
    "angle_noise": Range(absolute=(1e-3, 1e-2)),
    "track_half_length": Range(relative=(-0.5, 0.0)),
}


@pytest.fixture
def environments(
    make_plant: Callable[..., SimulatedPlant],
    make_environment: Callable[..., CartPoleEnv],
    both_poles: PoleSettings,
) -> tuple[CartPoleEnv, TransformedEnv]:
    """Our environment, and the same parts in TorchRL's TransformedEnv."""

    def plant() -> SimulatedPlant:
        return make_plant(CARTS, poles=both_poles, ranges=RANGES, start=ANYWHERE, seed=7)

    ours = make_environment(plant(), time_limit=LIMIT, past_velocities=2, pole_length=True)
    parts = ours.hardware
    hardware = HardwareTransform(parts.motors.tolist(), parts.task, parts.observation_settings, parts.reward)
    return ours, TransformedEnv(plant(), hardware)


def assert_equal(ours: TensorDictBase, theirs: TensorDictBase, but: tuple[str, ...] = ()) -> None:
    assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
    assert (ours.batch_size, ours.device) == (theirs.batch_size, theirs.device)
    for key in ours.keys(True, True):
        if key not in but:
            assert ours[key].dtype == theirs[key].dtype
            assert torch.equal(ours[key], theirs[key]), key


def test_equals_torchrls_step(environments: tuple[CartPoleEnv, TransformedEnv]) -> None:
    endings: dict[str, Any] = {"terminated": [], "truncated": []}
    for ours, theirs in zip(*(course(env, 150) for env in environments), strict=True):
        assert_equal(ours[0], theirs[0])
        assert_equal(ours[1], theirs[1], but=("action",))  # of the step that was made
        for key, rows in endings.items():
            rows.append(ours[0]["next", key].sum().item())
    for rows in endings.values():
        assert sum(rows) > 20
        assert any(0 < count < CARTS for count in rows)


def test_a_skipped_step_moves_no_cart(environments: tuple[CartPoleEnv, TransformedEnv]) -> None:
    """`_step` is TorchRL's mask."""
    for env in environments:
        present = env.reset().set("action", torch.ones(CARTS, dtype=torch.int64))
        before = env.base_env.true_state.x.clone()
        env.step(present.set("_step", torch.zeros(CARTS, dtype=torch.bool)))
        assert torch.equal(env.base_env.true_state.x, before)


def test_keeps_the_keys_that_a_policy_wrote(environments: tuple[CartPoleEnv, TransformedEnv]) -> None:
    env = environments[0]
    present = env.reset().set("action", torch.ones(CARTS, dtype=torch.int64))
    present["memory"] = torch.arange(CARTS)
    _, present = env.step_and_maybe_reset(present)
    assert torch.equal(present["memory"], torch.arange(CARTS))
    assert "next" not in present
    assert "reward" not in present
