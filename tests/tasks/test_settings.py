"""The task's settings: possible action sets, and the score that judges an agent."""

import pytest
from pydantic import ValidationError

from cartpole_rl.choices import choice
from cartpole_rl.tasks.settings import ActionSettings, TaskSettings


@pytest.mark.parametrize("motors", [[], [100], [100, 100], [0, 256], [-256, 0]])
def test_impossible_action_sets_are_refused(motors: list[int]) -> None:
    with pytest.raises(ValidationError):
        ActionSettings(motors=motors, actuator="newtons")


def test_an_unknown_actuator_is_refused() -> None:
    with pytest.raises(ValidationError):
        ActionSettings(motors=[-1, 1], actuator="rocket")


@pytest.mark.parametrize(("task", "measure"), [("balance", "score_upright"), ("swingup", "score")])
def test_a_balance_is_judged_by_6_1_and_a_swing_up_by_6_2(task: str, measure: str) -> None:
    assert TaskSettings(**{**choice(f"task/{task}"), "x_max": 0.38}).measure == measure


def test_an_episode_lasts_as_many_seconds_at_any_control_period() -> None:
    task = TaskSettings(**{**choice("task/swingup"), "x_max": 0.38})
    assert [task.at(period).periods for period in (0.01, 0.02, 0.03, 0.04)] == [1000, 500, 333, 250]
    assert task.model_copy(update={"time_limit": 300}).at(0.01).periods == 300
    with pytest.raises(ValidationError, match="give duration"):
        TaskSettings(**{**choice("task/swingup"), "x_max": 0.38, "duration": None})
