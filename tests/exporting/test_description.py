"""The definition of each number of an observation gives the observation of the environment."""

import math
from collections import defaultdict, deque
from typing import Any

import pytest

from cartpole_rl.envs.build import simulated_env
from cartpole_rl.errors import ConfigError
from cartpole_rl.exporting.description import definitions, observed_numbers
from cartpole_rl.tasks.features import Quantity
from cartpole_rl.workflows.config import TrainConfig
from cartpole_rl.workflows.loading import load_settings


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"observation": "raw"},
        {"observation": "positions"},
        {"observation": "history_length", "pole": "range", "observation.past_velocities": 2},
    ],
    ids=["history", "raw", "positions", "length"],
)
def test_the_definition_is_the_observation(overrides: dict[str, Any]) -> None:
    training = load_settings(TrainConfig, {**overrides, "guard": "none", "task.time_limit": 30})
    numbers = observed_numbers(training.observation)
    env = simulated_env(training, training.plant, 1, training.task.start, seed=1)
    cart, count = env.one_cart, len(training.actions.motors)
    past: deque = deque([defaultdict(float)] * 17, 17)
    step: Any = cart.reset()
    for period in range(20):
        x, x_dot, theta, theta_dot = step.state
        now = {"x": x, "x_dot": x_dot, "theta": theta, "theta_dot": theta_dot}
        now |= {"cos_theta": math.cos(theta), "sin_theta": math.sin(theta)}
        past.appendleft(now | {"pole_length": float(env.plant.pole_length)})
        found = [past[number.periods_ago][number.name] / number.scale for number in numbers]
        assert found == pytest.approx(step.observation, rel=1e-5, abs=1e-6)
        action = 7 * period % count
        past[0]["motor"] = cart.motor(action)
        step = cart.step(action)


def test_a_quantity_without_a_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="has no name; name its Quantity"):
        definitions([Quantity(lambda state: state.x, -1)], 0)
