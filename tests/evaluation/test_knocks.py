"""A pole that stands is knocked once in each episode, to either side in turn."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from cartpole_rl.evaluation.episodes import Knocks, run_episodes
from cartpole_rl.tasks.settings import Start, StartSettings

UPRIGHT = StartSettings(
    angle=Start.UPRIGHT, position_spread=0, angle_spread=0, speed_spread=0, angular_speed_spread=0
)


def without_motor(seen: TensorDictBase) -> TensorDictBase:
    return seen.set("action", torch.full(seen.batch_size, 1))  # of -200, 0, 200


def test_a_pole_is_knocked_after_it_stood_for_two_seconds(simulated: Callable) -> None:
    env = simulated(2, {"start": UPRIGHT}, time_limit=110)  # a pole exactly upright stays there
    left_alone = list(run_episodes(env, without_motor, 2))
    knocked = list(run_episodes(env, without_motor, 4, Knocks(env.plant, 3.0)))
    assert all(np.abs(each.theta).max() == 0 for each in left_alone)
    for episode, sign in zip(knocked, (1, -1, 1, -1), strict=True):
        assert np.abs(episode.theta[:100]).max() == 0  # rad
        moved = sign * (episode.theta[101] - episode.theta[100])
        assert moved == pytest.approx(3.0 * 0.02, rel=0.1)


def test_a_hanging_pole_is_left_alone(simulated: Callable) -> None:
    env = simulated(time_limit=150)
    (episode,) = run_episodes(env, without_motor, 1, Knocks(env.plant, 3.0))
    assert np.ptp(episode.theta) == 0
