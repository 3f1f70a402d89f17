"""The task's settings: possible action sets and starts, and the score that judges an agent."""

import math
from contextlib import nullcontext

import pytest
from pydantic import ValidationError

from cartpole_rl.choices import choice
from cartpole_rl.errors import ConfigError
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


@pytest.mark.parametrize(
    ("task", "changes", "refused"),
    [
        ("balance", {}, ""),
        ("swingup", {}, ""),
        ("balance", {"angle_spread": 0.2094396}, ""),  # within the limit
        ("balance", {"angle_spread": 0.21}, "start.angle_spread=0.21"),
        ("balance", {"angle_spread": 0.21, "angle": "any"}, "start.angle=any"),
        ("balance", {"resting_share": 0.5}, "start.resting_share=0.5"),
    ],
)
def test_episodes_do_not_start_where_they_end(task: str, changes: dict, refused: str) -> None:
    """The pole of an episode that starts at rest hangs."""
    given = {**choice(f"task/{task}"), "x_max": 0.38}
    for name in ("start", "evaluation_start"):
        made = TaskSettings(**{**given, name: {**given[name], **changes}})
        complaint = rf"task\.{name.removesuffix('start')}{refused}: episodes would start up to .* end at once"
        with pytest.raises(ConfigError, match=complaint) if refused else nullcontext():
            made.check_starts()


@pytest.mark.parametrize(("limit", "taken"), [(0.2, True), (math.pi, True), (0.0, False), (3.2, False)])
def test_a_limit_of_the_angle_is_within_half_a_turn(limit: float, taken: bool) -> None:
    given = {**choice("task/balance"), "x_max": 0.38, "angle_limit": limit}
    with nullcontext() if taken else pytest.raises(ValidationError, match="above 0 and at most pi"):
        TaskSettings(**given)
